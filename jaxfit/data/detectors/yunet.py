"""YuNet (Wu, Peng and Yu, 2023): a small network that finds faces of any pose, run by OpenCV. Its file comes along."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from threading import local
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxfit.data.boxes import box_centre
from jaxfit.data.detectors.detector import Detection, Search, largest_first, merged
from jaxfit.data.pictures import Pixels, to_eight_bits
from jaxfit.errors import InputError

KIND = "yunet"

_FILE = "face_detection_yunet_2023mar.onnx"
# Measured on labelled faces of those sizes: of faces that are 32 pixels wide for the network hardly any is
# missed, of 24 pixels 1 in 25, of 16 pixels every fourth; faces of 600 pixels are still found.
_SEEN = 32.0  # width of the smallest face, in the network's pixels
_LARGEST = 640  # longer side, in the network's pixels, from which a coarser level looks for larger faces
_COARSER = 4  # times that a level is coarser than the one before
_TILE, _SHARED = 1280, 256  # sides of the parts that a large level is looked at in, and how far they overlap
_SCORE = 0.7
_SAME = 0.3  # overlap from which two finds are one face
_MOST = 5000  # finds in a part
_NARROWEST = 16  # pixels of a part in which a face can be seen; in narrower ones the network finds what is not there
# Degrees from which a turned face is looked at again, turned upright, in a patch of so many pixels, at such a size.
# so often, until it is as good as upright.
_TURNED, _UPRIGHT, _LOOKS, _PATCH, _PATCH_FACE = 12.0, 4.0, 3, 192, 80.0
_MORE = 1.3  # times that faces are more turned than the network believes


class _Part(NamedTuple):
    """A part of a picture, at the network's resolution.

    Attributes:
        bgr: uint8 (H, W, 3).
        corner: (2,) x, y of its upper left corner in the picture.
        scale: (2,) network's pixels a picture pixel, across and down.
    """

    bgr: np.ndarray
    corner: np.ndarray
    scale: np.ndarray


@dataclass(frozen=True)
class YuNet:
    """Finds faces of any pose, also small ones and many in a picture, and how they are turned in it.

    Pictures are looked at at the resolution that the smallest faces need, large ones in overlapping parts, and again at
    coarser resolutions for large faces.

    Attributes:
        search: the smallest face, and the score from which a find is a face.
        path: an ONNX file; None takes the one of the package.

    Raises:
        InputError: the file is missing, or not a YuNet that this OpenCV can run.
    """

    search: Search = field(default_factory=Search)
    path: str | Path | None = None
    # A network looks at one picture at a time: each thread has its own.
    _of_thread: Any = field(default_factory=local, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.path is not None and not Path(self.path).is_file():
            raise InputError(f"yunet: expected YuNet's ONNX file; there is no file {self.path}")
        try:
            self._found(np.zeros((64, 64, 3), np.uint8))
        except cv2.error as error:
            raise InputError(
                f"yunet: {self.path} is not a YuNet that OpenCV {cv2.__version__} can run; {error.err}"
            ) from None

    @property
    def kinds(self) -> tuple[str, ...]:
        """One kind for all poses."""
        return (KIND,)

    @property
    def colour(self) -> bool:
        """Yes."""
        return True

    @property
    def rough(self) -> bool:
        """No: a second pass gains nothing, as ``scripts/detectors.py`` measures."""
        return False

    def __call__(self, image: Pixels) -> list[Detection]:
        """The faces in a picture, as in `jaxfit.data.pictures.to_eight_bits`, largest first."""
        image = to_eight_bits(image)
        bgr = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if image.ndim == 2 else cv2.COLOR_RGB2BGR)
        parts = _parts(bgr, self.search.smallest_in(bgr.shape))
        found = merged((face for part in parts for face in self._faces(part)), _SAME)
        return largest_first([self._looked_at_upright(bgr, face) for face in found])

    def _looked_at_upright(self, bgr: np.ndarray, face: Detection) -> Detection:
        """A face whose rotation and box are those of a second look, at the picture turned upright: the network
        believes turned faces to be less turned than they are, and draws other boxes around them."""
        if abs(face.rotation) < _TURNED:
            return face
        face = replace(face, rotation=_MORE * face.rotation)
        for _ in range(_LOOKS):
            centre, side = box_centre(face.box), float(face.box[2:].mean())
            scale, radians = _PATCH_FACE / side, math.radians(face.rotation)
            turn = scale * np.array([[math.cos(radians), math.sin(radians)], [-math.sin(radians), math.cos(radians)]])
            there = np.column_stack([turn, _PATCH / 2 - turn @ centre])
            flags = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
            patch = cv2.warpAffine(bgr, there, (_PATCH, _PATCH), flags=flags, borderMode=cv2.BORDER_REPLICATE)
            seen = [each for each in self._faces(_Part(patch, np.zeros(2), np.ones(2))) if _in_the_middle(each.box)]
            if not seen:
                break
            best = max(seen, key=lambda each: each.score)
            middle = np.linalg.solve(turn, box_centre(best.box) - there[:, 2])
            sides = best.box[2:] / scale
            rotation = (face.rotation + _MORE * best.rotation + 180) % 360 - 180
            turned_by = abs(best.rotation)
            face = replace(face, box=np.concatenate([middle - sides / 2, sides]), rotation=rotation)
            if turned_by < _UPRIGHT:
                break
        return face

    def _faces(self, part: _Part) -> Iterator[Detection]:
        for values in self._found(part.bgr).astype(np.float64):
            if np.isfinite(values).all() and min(values[2:4]) > 0:
                box = np.concatenate([values[:2] / part.scale + part.corner, values[2:4] / part.scale])
                yield Detection(box, KIND, _rotation(values[4:14].reshape(5, 2)), float(values[14]))

    def _found(self, bgr: np.ndarray) -> np.ndarray:
        """A row a face: x, y, width, height, the two eyes, the nose, the corners of the mouth, and the score."""
        size = (bgr.shape[1], bgr.shape[0])
        if min(size) < _NARROWEST:
            return np.empty((0, 15), np.float32)
        if not hasattr(self._of_thread, "network"):
            score = _SCORE if self.search.score is None else self.search.score
            with resources.as_file(resources.files(__package__) / "bundled" / _FILE) as bundled:
                path = str(bundled if self.path is None else self.path)
                self._of_thread.network = cv2.FaceDetectorYN.create(path, "", size, score, _SAME, _MOST)
        self._of_thread.network.setInputSize(size)
        faces = self._of_thread.network.detect(bgr)[1]
        return np.empty((0, 15), np.float32) if faces is None else faces


def _in_the_middle(box: np.ndarray) -> bool:
    """Whether a box (4,) of a patch is that of the face in its middle."""
    away = np.abs(box_centre(box) - _PATCH / 2).max()
    return bool(away < 0.5 * _PATCH_FACE and 0.5 < box[2:].mean() / _PATCH_FACE < 2)


def _rotation(points: np.ndarray) -> float:
    """How far a face is turned in the picture, in degrees, clockwise as seen, by its five points: the eyes, nose,
    and corners of the mouth, the left ones in the picture first. On profiles, whose eyes coincide, eyes and
    mouth tell."""
    across = points[1] - points[0]
    down = points[3:].mean(0) - points[:2].mean(0)
    x, y = across + [down[1], -down[0]]
    return math.degrees(math.atan2(y, x))


def _parts(bgr: np.ndarray, smallest: float) -> Iterator[_Part]:
    """What the network looks at: the picture at the resolution that the smallest faces need, and coarser ones."""
    scale, longest = _SEEN / smallest, max(bgr.shape[:2])
    while True:
        for top, bottom in _tiles(bgr.shape[0], scale):
            for left, right in _tiles(bgr.shape[1], scale):
                yield _part(bgr, left, top, right, bottom, scale)
        if scale * longest <= _LARGEST:
            return
        scale = max(scale / _COARSER, min(scale / 1.5, _LARGEST / longest))


def _part(bgr: np.ndarray, left: int, top: int, right: int, bottom: int, scale: float) -> _Part:
    part = bgr[top:bottom, left:right]
    height, width = part.shape[:2]
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    if size != (width, height):
        part = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    return _Part(np.ascontiguousarray(part), np.array([left, top]), np.array([size[0] / width, size[1] / height]))


def _tiles(length: int, scale: float) -> list[tuple[int, int]]:
    """Overlapping intervals that cover so many pixels, of a length that is ``_TILE`` for the network."""
    tile, shared = math.ceil(_TILE / scale), math.ceil(_SHARED / scale)
    if length <= tile:
        return [(0, length)]
    count = math.ceil((length - shared) / (tile - shared))
    firsts = np.linspace(0, length - tile, count).round().astype(int).tolist()
    return [(first, first + tile) for first in firsts]
