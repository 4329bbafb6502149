"""Fixed-size grey crops around faces, and the way from crop pixels to image pixels and back.

A crop is an axis-aligned, evenly scaled part of its image: image point = ``scale`` · crop point + ``offset``.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from jaxfit.exceptions import InputError
from jaxfit.image.frame import Frame

# Picture pixels a crop pixel up to which a bilinear sample stands for all of them.
_ONE_SAMPLE = 1.5


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

    Beyond the picture its edge pixels are repeated.

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
    part, corner, blocks = _shrunk(grey, offset, scale, frame.crop)
    # Left to shrink is less than twofold: a bilinear sample a crop pixel, or four where one would miss much.
    samples = 2 if scale / max(1, int(scale)) > _ONE_SAMPLE else 1
    step = scale / samples
    start = (offset - corner + (step - scale) / 2 - (blocks - 1) / 2) / blocks
    pixels = cv2.warpAffine(
        part,
        np.array([[step / blocks[0], 0, start[0]], [0, step / blocks[1], start[1]]]),
        (frame.crop * samples, frame.crop * samples),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    if samples > 1:
        pixels = cv2.resize(pixels, (frame.crop, frame.crop), interpolation=cv2.INTER_AREA)
    return Crop(pixels, scale, offset)


def to_image(points: np.ndarray, scale: float | np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Crop points (..., 2) as image points, both in pixels; for batches, ``scale`` and ``offset`` must broadcast."""
    return points * scale + offset


def to_crop(points: np.ndarray, scale: float | np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Image points (..., 2) as crop points, both in pixels: the inverse of :func:`to_image`."""
    return (points - offset) / scale


def _shrunk(grey: np.ndarray, offset: np.ndarray, scale: float, crop: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The part of the picture under the crop, at least a pixel of it, shrunk as far as whole pixels allow.

    Returns:
        The means of its blocks of pixels; the (2,) point of the part's first pixel; and the blocks' sides, x and y.
    """
    last = np.array([grey.shape[1] - 1, grey.shape[0] - 1])
    first_wanted, last_wanted = np.floor(offset - scale), np.ceil(offset + scale * (crop + 1)) + 1
    block = max(1, int(scale))
    low, high = (np.clip(wanted, 0, last).astype(int) for wanted in (first_wanted, last_wanted))
    low = low // block * block  # blocks are counted from the picture's corner
    part = grey[low[1] : high[1] + 1, low[0] : high[0] + 1]
    # A part that is not as long as a block is left as it is.
    size = high - low + 1
    blocks = np.where(size < block, 1, block)
    if block > 1:
        # Where the picture ends its edge goes on for the rest of a block and one more.
        before, after = blocks * (first_wanted < 0), -size % blocks + blocks * (last_wanted > last)
        (left, top), (right, bottom) = before.tolist(), after.tolist()
        part = cv2.copyMakeBorder(part, top, bottom, left, right, cv2.BORDER_REPLICATE)
        low, size = low - before, (size + before + after) // blocks
        part = cv2.resize(part, (int(size[0]), int(size[1])), interpolation=cv2.INTER_AREA)
    return part, low, blocks
