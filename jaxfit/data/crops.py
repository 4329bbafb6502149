"""Fixed-size grey crops around faces, and the way from crop pixels to image pixels and back.

A crop is an evenly scaled and turned part of its image: image point = ``scale`` · R · crop point + ``offset``, with R
the rotation by ``rotation``.
Where to cut is worked out in plain numbers: on arrays of two it takes as long as the cutting.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from jaxfit.errors import InputError
from jaxfit.image.frame import Frame

# Picture pixels a crop pixel up to which a bilinear sample stands for all of them.
_ONE_SAMPLE = 1.5
_WIDE = 2**14  # OpenCV warps no picture of twice as many pixels across


class Crop(NamedTuple):
    """One crop and where it was.

    Attributes:
        pixels: (crop, crop) uint8.
        scale: image pixels per crop pixel.
        offset: (2,) float64, the image point, x and y in pixels, under the centre of the crop's first pixel.
        rotation: of the crop in the image, in radians, clockwise as seen.
    """

    pixels: np.ndarray
    scale: float
    offset: np.ndarray
    rotation: float


@dataclass(frozen=True, eq=False)
class Crops:
    """N crops of one size; the arrays are filled in place, so that no crop exists twice.

    Attributes:
        frame: size of the crops.
        pixels: (N, crop, crop) uint8.
        scale: (N,) float64, image pixels per crop pixel.
        offset: (N, 2) float64, the image point under the centre of each crop's first pixel.
        rotation: (N,) float64, of each crop in its image, in radians, clockwise as seen.
    """

    frame: Frame
    pixels: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    rotation: np.ndarray

    @classmethod
    def empty(cls, count: int, frame: Frame) -> "Crops":
        """Black crops, each the first pixels of its picture."""
        pixels = np.zeros((count, frame.crop, frame.crop), np.uint8)
        return cls(frame, pixels, np.ones(count), np.zeros((count, 2)), np.zeros(count))

    @classmethod
    def of(cls, crops: Sequence[Crop | str], frame: Frame) -> "Crops":
        """Crops that were cut; where there is a reason in place of one, it is black."""
        several = cls.empty(len(crops), frame)
        for row, crop in enumerate(crops):
            if not isinstance(crop, str):
                several.pixels[row], several.scale[row], several.offset[row], several.rotation[row] = crop
        return several

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Pixels, scales, offsets and rotations."""
        return self.pixels, self.scale, self.offset, self.rotation

    def to_images(self, points: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Points (M, L, 2) of the crops numbered ``rows`` (M,), all if None, from their pixels to the pictures'."""
        return to_image(points, *self._lenses(rows))

    def from_images(self, points: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Points (M, L, 2), from pixels of the pictures to those of the crops numbered ``rows`` (M,), all if None."""
        return to_crop(points, *self._lenses(rows))

    def covariances_to_images(self, covariances: np.ndarray) -> np.ndarray:
        """Covariances (N, L, 2, 2) of points of all crops, from squares of their pixels to squares of the pictures'."""
        cos, sin = np.cos(self.rotation), np.sin(self.rotation)
        turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
        turned = np.einsum("nij,nljk,nmk->nlim", turn, covariances, turn)
        return self.scale[:, None, None, None] ** 2 * turned

    def _lenses(self, rows: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        chosen = slice(None) if rows is None else rows
        return self.scale[chosen][:, None, None], self.offset[chosen][:, None], self.rotation[chosen][:, None]


def cut(grey: np.ndarray, centre: np.ndarray, face_side: float, crops: Crops, row: int, rotation: float = 0.0) -> None:
    """Fill crop ``row`` with the crop of a face; arguments and errors are those of :func:`cut_face`."""
    found = cut_face(grey, centre, face_side, crops.frame, rotation)
    crops.pixels[row], crops.scale[row], crops.offset[row], crops.rotation[row] = found


def cut_face(
    picture: np.ndarray, centre: np.ndarray, face_side: float, frame: Frame, rotation: float = 0.0, colour: bool = False
) -> Crop:
    """The crop of a picture that shows a face upright and at the frame's size in its middle.

    Beyond the picture its edge pixels are repeated. Image points are where labels have them: at a ``frame.shift``,
    along the crop's axes, from the pixels that they mark.

    Args:
        picture: (H, W) or (H, W, 3) RGB, uint8.
        centre: (2,) x, y of the image point that comes to the crop's centre, ``frame.middle``.
        face_side: how many image pixels become ``frame.face`` crop pixels.
        frame: the sizes.
        rotation: how far the face is turned in the picture, in radians, clockwise as seen.
        colour: keep the colours of a picture that has some.

    Raises:
        InputError: the centre, the side or the rotation is not finite, or the side is not positive.
    """
    across, down = map(float, centre)
    if not (all(map(math.isfinite, (across, down, face_side, rotation))) and face_side > 0):
        raise InputError(
            f"expected a finite centre and rotation and a positive face side; got {centre}, {rotation} and {face_side}"
        )
    scale, middle = float(face_side) / frame.face, frame.middle
    cos, sin = math.cos(rotation), math.sin(rotation)
    # The middle's arm to the first pixel, turned; and how far the turned crop reaches along the picture's axes.
    arm_x, arm_y = middle * (cos - sin), middle * (cos + sin)
    left, top = across - scale * arm_x, down - scale * arm_y
    x, y = left - frame.shift * (cos - sin), top - frame.shift * (cos + sin)
    reach = middle * (abs(cos) + abs(sin))
    wide = math.ceil(2 * reach) + 1
    corner = scale * (reach - arm_x), scale * (reach - arm_y)
    columns = _side(picture.shape[1], x - corner[0], scale, wide)
    rows = _side(picture.shape[0], y - corner[1], scale, wide)
    part = picture[rows.low : rows.high, columns.low : columns.high]
    if part.ndim == 3 and not colour:
        part = cv2.cvtColor(part, cv2.COLOR_RGB2GRAY)  # not the whole picture, which takes as long as the cutting
    part = _shrunk(part, columns, rows)
    # Left to shrink is less than twofold: a bilinear sample a crop pixel, or four where one would miss much.
    samples = 2 if scale / max(1, int(scale)) > _ONE_SAMPLE else 1
    step = scale / samples
    between = (step - scale) / 2
    pixels = cv2.warpAffine(
        part,
        np.array(
            [
                [step * cos / columns.block, -step * sin / columns.block, columns.at(x + between * (cos - sin))],
                [step * sin / rows.block, step * cos / rows.block, rows.at(y + between * (cos + sin))],
            ],
        ),
        (frame.crop * samples, frame.crop * samples),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    if samples > 1:
        pixels = cv2.resize(pixels, (frame.crop, frame.crop), interpolation=cv2.INTER_AREA)
    return Crop(pixels, scale, np.array((left, top)), rotation)


def to_image(
    points: np.ndarray, scale: float | np.ndarray, offset: np.ndarray, rotation: float | np.ndarray = 0.0
) -> np.ndarray:
    """Crop points (..., 2) as image points, both in pixels; for batches, the others must broadcast: ``scale`` and
    ``offset`` with the points, ``rotation``, in radians, with one of their coordinates."""
    return turned(points, rotation) * scale + offset


def to_crop(
    points: np.ndarray, scale: float | np.ndarray, offset: np.ndarray, rotation: float | np.ndarray = 0.0
) -> np.ndarray:
    """Image points (..., 2) as crop points, both in pixels: the inverse of :func:`to_image`."""
    return turned((points - offset) / scale, -np.asarray(rotation))


def turned(points: np.ndarray, rotation: float | np.ndarray) -> np.ndarray:
    """Points (..., 2) turned about the origin by angles in radians, clockwise as seen."""
    if not np.any(rotation):
        return points
    cos, sin = np.cos(rotation), np.sin(rotation)
    x, y = points[..., 0], points[..., 1]
    return np.stack([x * cos - y * sin, x * sin + y * cos], -1)


class _Side(NamedTuple):
    """Columns or rows of a picture, at least one, that blocks are made of.

    Attributes:
        low: the first.
        high: the one after the last.
        before: how often the first is repeated before it.
        after: and the last after it.
        block: how many become one.
    """

    low: int
    high: int
    before: int
    after: int
    block: int

    @property
    def size(self) -> int:
        """How many blocks there are."""
        return (self.high - self.low + self.before + self.after) // self.block

    def at(self, place: float) -> float:
        """A place in the picture, in blocks from the middle of the first."""
        return (place - (self.low - self.before) - (self.block - 1) / 2) / self.block


def _side(size: int, offset: float, scale: float, crop: int) -> _Side:
    """The columns or rows, of ``size``, under a crop whose first is at ``offset``, in blocks of as many as fit."""
    first_wanted, last_wanted = math.floor(offset - scale), math.ceil(offset + scale * (crop + 1)) + 1
    last = size - 1
    low, high = min(max(first_wanted, 0), last), min(max(last_wanted, 0), last) + 1
    block = int(scale)
    if block < 2:
        return _Side(low, high, 0, 0, 1)
    low = low // block * block  # blocks are counted from the picture's corner
    if high - low < block:  # a picture that is lost in its crop is not padded to many times its size
        block = max(1, (high - low) // _WIDE)
    # Where the picture ends its edge goes on for the rest of a block and one more.
    before, after = block * (first_wanted < 0), -(high - low) % block + block * (last_wanted > last)
    return _Side(low, high, before, after, block)


def _shrunk(part: np.ndarray, columns: _Side, rows: _Side) -> np.ndarray:
    """The means of blocks of pixels."""
    around = (rows.before, rows.after, columns.before, columns.after)
    if any(around):
        part = cv2.copyMakeBorder(part, *around, cv2.BORDER_REPLICATE)
    size = (columns.size, rows.size)
    return part if part.shape[:2] == size[::-1] else cv2.resize(part, size, interpolation=cv2.INTER_AREA)
