"""Fixed-size grey crops around faces, and the way from crop pixels to image pixels and back.

A crop is an axis-aligned, evenly scaled part of its image: image point = ``scale`` · crop point + ``offset``.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from jaxfit.exceptions import InputError
from jaxfit.image.frame import Frame

# Samples per crop pixel and axis when shrinking: enough against aliasing, and it bounds the work on huge pictures.
_MOST_SAMPLES = 8
_LONGEST = 32_000  # pixels; OpenCV cannot warp pictures with sides from 32,767, such as panoramas


class Crop(NamedTuple):
    """One crop and where it was.

    Attributes:
        pixels: (crop, crop) uint8.
        scale: image pixels per crop pixel.
        offset: (2,) float64, the image point, x and y in pixels, under the centre of the crop's first pixel.
    """

    pixels: np.ndarray
    scale: float
    offset: np.ndarray


@dataclass(frozen=True, eq=False)
class Crops:
    """N crops of one size; the arrays are filled in place, so that no crop exists twice.

    Attributes:
        frame: size of the crops.
        pixels: (N, crop, crop) uint8.
        scale: (N,) float64, image pixels per crop pixel.
        offset: (N, 2) float64, the image point under the centre of each crop's first pixel.
    """

    frame: Frame
    pixels: np.ndarray
    scale: np.ndarray
    offset: np.ndarray

    @classmethod
    def empty(cls, count: int, frame: Frame) -> "Crops":
        """Black crops, each the first pixels of its picture."""
        pixels = np.zeros((count, frame.crop, frame.crop), np.uint8)
        return cls(frame, pixels, np.ones(count), np.zeros((count, 2)))

    def __len__(self) -> int:
        return len(self.pixels)

    def to_images(self, points: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Points (M, L, 2) of the crops numbered ``rows`` (M,), all if None, from their pixels to the pictures'."""
        return to_image(points, *self._lenses(rows))

    def from_images(self, points: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Points (M, L, 2), from pixels of the pictures to those of the crops numbered ``rows`` (M,), all if None."""
        return to_crop(points, *self._lenses(rows))

    def _lenses(self, rows: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        chosen = slice(None) if rows is None else rows
        return self.scale[chosen][:, None, None], self.offset[chosen][:, None]


def cut(grey: np.ndarray, centre: np.ndarray, face_side: float, crops: Crops, row: int) -> None:
    """Fill crop ``row`` with the crop of a face; arguments and errors are those of :func:`cut_face`."""
    crops.pixels[row], crops.scale[row], crops.offset[row] = cut_face(grey, centre, face_side, crops.frame)


def cut_face(grey: np.ndarray, centre: np.ndarray, face_side: float, frame: Frame) -> Crop:
    """The crop of a grey picture, uint8 (H, W), that shows a face at the frame's size in its middle.

    Beyond the picture its edge pixels are repeated. The work depends on the crop's size only, not on the picture's.

    Args:
        grey: (H, W) uint8.
        centre: (2,) x, y of the image point that comes to the crop's centre, ``frame.middle``.
        face_side: how many image pixels become ``frame.face`` crop pixels.
        frame: the sizes.

    Raises:
        InputError: the centre or the side is not finite, or the side is not positive.
    """
    if not (np.isfinite(centre).all() and np.isfinite(face_side) and face_side > 0):
        raise InputError(f"expected a finite centre and a positive face side; got {centre} and {face_side}")
    scale = float(face_side) / frame.face
    offset = np.asarray(centre, np.float64) - scale * frame.middle
    part, corner, stride = _around(grey, offset, scale, frame.crop)
    # When shrinking, each crop pixel is the mean of n × n bilinear samples spread evenly over its area.
    samples = min(max(math.ceil(scale), 1), _MOST_SAMPLES)
    step = scale / samples
    start = (offset - corner + (step - scale) / 2) / stride
    dense = cv2.warpAffine(
        part,
        np.array([[step / stride, 0, start[0]], [0, step / stride, start[1]]]),
        (frame.crop * samples, frame.crop * samples),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    pixels = cv2.resize(dense, (frame.crop, frame.crop), interpolation=cv2.INTER_AREA)
    return Crop(pixels, scale, offset)


def to_image(points: np.ndarray, scale: float | np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Crop points (..., 2) as image points, both in pixels; for batches, ``scale`` and ``offset`` must broadcast."""
    return points * scale + offset


def to_crop(points: np.ndarray, scale: float | np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Image points (..., 2) as crop points, both in pixels: the inverse of :func:`to_image`."""
    return (points - offset) / scale


def _around(grey: np.ndarray, offset: np.ndarray, scale: float, crop: int) -> tuple[np.ndarray, np.ndarray, int]:
    """The part of the picture under the crop, at least a pixel of it, and the (2,) point of the part's first pixel.

    Of a part too long for OpenCV only every n-th row and column is taken; n, mostly 1, comes last.
    """
    last = np.array([grey.shape[1] - 1, grey.shape[0] - 1])
    low = np.clip(np.floor(offset - scale), 0, last).astype(int)
    high = np.clip(np.ceil(offset + scale * crop) + 1, 0, last).astype(int)
    stride = math.ceil((high - low + 1).max() / _LONGEST)
    return grey[low[1] : high[1] + 1 : stride, low[0] : high[0] + 1 : stride], low, stride
