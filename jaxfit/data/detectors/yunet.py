"""YuNet (Wu, Peng and Yu, 2023): a small network that finds faces of any pose, run by OpenCV. Its file comes along."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from threading import local
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxfit.data.boxes import box_centre
from jaxfit.data.crops import cut_face, to_image
from jaxfit.data.detectors.detector import Detection, Search, merged, turned_back
from jaxfit.data.pictures import Pixels, to_eight_bits
from jaxfit.errors import InputError
from jaxfit.image.frame import Frame

KIND = "yunet"

_FILE = "face_detection_yunet_2023mar.onnx"
# Of labelled faces that are 16 pixels wide for the network, half have the usual score and 9 in 10 the score of
# doubtful finds; of 20 pixels 76 and 99 in 100; of 32 pixels all have both. Faces of 600 pixels are still found.
_QUICK, _CLEAR = 18.0, 32.0  # width of the smallest face, in the network's pixels, at first and if no face is sure
_CLOSE = 40.0  # width up to which a find is looked at closer, in a patch
_LEAST = 0.67  # of the smallest face's width that a find has at least: more of what is smaller is no face
_LARGEST = 640  # longer side, in the network's pixels, from which a coarser level looks for larger faces
_COARSER = 4  # times that a level is coarser than the one before
_TILE, _SHARED = 1280, 256  # sides of the parts that a large level is looked at in, and how far they overlap
_SCORE = 0.7
_SAME = 0.3  # overlap from which two finds are one face
_MOST = 5000  # finds in a part
_DARK = 64  # value that all but 1 in 100 pixels of a dark picture stay below
_NARROWEST = 16  # pixels of a part in which a face can be seen; in narrower ones the network finds what is not there
# Most upright faces of photographs have scores above 0.9; of turned faces that are seen upright 1 in 50 has less than
# 0.88, and most of what is no face. A find with less, or one that is turned, is looked at again in a patch, turned as
# the network believes and to the sides. It sees turned faces best where they are large.
_UPRIGHT, _SURE = 12.0, 0.88  # degrees up to which a find is upright, and the score from which there is no doubt of it
_LIKELY = 0.8  # score from which an upright find is a face, if no other rotation is better
_LEANING = 15.0  # degrees up to which hardly a face is missed at the usual score, in a group of which some lean more
_DOUBTFUL = 0.05  # score of finds that may be turned faces: small ones at 45 degrees often have no more
_MOST_SMALL, _MOST_TURNED = 200, 30  # of them in a picture that are looked at closer, and turned
_FRAME = Frame(crop=256, face=128.0)
_CLOSER = Frame(crop=96, face=60.0)  # of closer looks: small, as most of them go to upright faces
_SIDES = (45.0, -45.0, 90.0, -90.0)
_ALL_SIDES = (*_SIDES, 135.0, -135.0, 180.0)
_BETTER = 0.01  # by which another rotation's score has to be better
_LOOKS, _ENOUGH = 2, 10.0  # how often a box is mended, and degrees from which that pays
# Faces are more turned than the network believes, by these factors, from small to large ones, in its pixels.
_BELIEVED, _TURNED = (80.0, 130.0), (3.0, 1.3)


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

    Pictures are looked at at a resolution at which the smallest faces leave at least a doubtful find, large pictures in
    overlapping parts, and again at coarser resolutions for large faces. Small finds are looked at closer, and those
    that are turned or doubtful, turned upright; those below the score unless most faces of the picture are upright.
    Where no face is sure, all this is done again at a finer resolution. Dark pictures are also looked at after they
    were made brighter.

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
            found = f"{self.path} is a folder" if Path(self.path).is_dir() else f"there is no file {self.path}"
            raise InputError(f"yunet: expected YuNet's ONNX file; {found}")
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
        faces, white = self._faces_in(bgr), float(np.quantile(bgr[::8, ::8], 0.99))
        if white < _DARK:
            faces += self._faces_in(cv2.convertScaleAbs(bgr, alpha=255 / max(1.0, white)))
        return merged(faces, _SAME)

    def _faces_in(self, bgr: np.ndarray) -> list[Detection]:
        faces = self._faces_at(bgr, _QUICK)
        if any(face.score >= _SURE for face in faces):
            return faces
        return merged([*faces, *self._faces_at(bgr, _CLEAR)], _SAME)

    def _faces_at(self, bgr: np.ndarray, width: float) -> list[Detection]:
        """The faces in a picture that is looked at so that the smallest face has this width for the network."""
        sure, doubtful = self._split(self._finds(bgr, width))
        finds = merged([*sure, *doubtful[:_MOST_SMALL]], _SAME)
        clear = self.search.smallest_in(bgr.shape) * _CLOSE / width
        sure, doubtful = self._split(
            self._looked_at_closer(bgr, face) if face.box[2:].mean() < clear else face for face in finds
        )
        faces = [self._looked_at_upright(bgr, face) for face in merged(sure, _SAME)]
        upright = [self._leaning(face) < _LEANING for face in faces if face.score >= _SURE]
        if not upright or np.mean(upright) <= 0.5:
            # The picture may be turned, and its faces be among the doubtful finds.
            others = self._split(merged([*sure, *doubtful[:_MOST_TURNED]], _SAME))[1]
            faces += [self._looked_at_upright(bgr, face) for face in others]
        return merged(self._split(faces)[0], _SAME)

    def _split(self, faces: Iterable[Detection]) -> tuple[list[Detection], list[Detection]]:
        """Those that have the score from which a find is a face, and the doubtful ones, best first."""
        ordered = sorted(faces, key=lambda face: face.score, reverse=True)
        sure = sum(face.score >= self._score for face in ordered)
        return ordered[:sure], ordered[sure:]

    @property
    def _quarters(self) -> range:
        """The quarters by which the picture is turned to be looked at."""
        return range(4 if self.search.any_rotation else 1)

    def _leaning(self, face: Detection) -> float:
        """How far a face is turned from where faces are surely found, in degrees."""
        return min(abs((face.rotation - 90 * quarters + 180) % 360 - 180) for quarters in self._quarters)

    def _finds(self, bgr: np.ndarray, width: float) -> Iterator[Detection]:
        """What the network finds in the picture, and in the picture turned by quarters if any rotation is asked for."""
        smallest = self.search.smallest_in(bgr.shape)
        for quarters in self._quarters:
            turned = np.ascontiguousarray(np.rot90(bgr, quarters))
            for part in _parts(turned, width / smallest):
                for face in self._faces(part):
                    if face.box[2:].mean() >= _LEAST * smallest:
                        yield turned_back(face, quarters, bgr.shape)

    @property
    def _score(self) -> float:
        return _SCORE if self.search.score is None else self.search.score

    def _looked_at_closer(self, bgr: np.ndarray, face: Detection) -> Detection:
        """A find that is small for the network as it is seen where it is larger; with the score 0 if it is not seen."""
        quarters = round(face.rotation / 90) if self.search.any_rotation else 0
        return self._turned(bgr, face, 90.0 * quarters, _CLOSER)[0]

    def _looked_at_upright(self, bgr: np.ndarray, face: Detection) -> Detection:
        """A find as it is seen where the picture is turned so that it is upright: the network is less sure of turned
        faces, believes them to be less turned than they are, and draws other boxes around them. Where no face is seen,
        the find stays as it is, with the score 0 if it lies or stands on its head."""
        score, degrees = face.score, face.rotation
        if score < _SURE:
            score = max(score, self._turned(bgr, face, degrees, _CLOSER)[0].score)
        if score < _SURE:
            sides = _ALL_SIDES if self.search.any_rotation else _SIDES
            turned = {side: self._turned(bgr, face, side, _CLOSER)[0].score for side in sides}
            side = max(turned, key=lambda side: turned[side])
            degrees = side if turned[side] > score + _BETTER else degrees
        if score >= _LIKELY and abs(face.rotation) < _UPRIGHT and degrees == face.rotation:
            return replace(face, score=score)
        best, settled = self._turned(bgr, face, degrees)
        for _ in range(_LOOKS):
            if not settled:
                best, settled = self._turned(bgr, best, best.rotation)
        if best.score >= _SURE:
            return replace(best, score=max(face.score, best.score))
        return face if abs(face.rotation) < 45 else replace(face, score=0.0)

    def _turned(
        self, bgr: np.ndarray, face: Detection, degrees: float, frame: Frame = _FRAME
    ) -> tuple[Detection, bool]:
        """A find as it is seen where the picture is turned back by so much, with the score 0 if it is not seen; and
        whether it is upright there, in the middle and of the expected size, so that its box is to be trusted."""
        crop = cut_face(
            bgr, box_centre(face.box), float(face.box[2:].mean()), frame, math.radians(degrees), colour=True
        )
        finds = self._faces(_Part(crop.pixels, np.zeros(2), np.ones(2)))
        inside = [each for each in finds if _in_the_middle(each.box, frame)]
        if not inside:
            return replace(face, rotation=degrees, score=0.0), True
        best = max(inside, key=lambda each: each.score)
        middle, sides = to_image(box_centre(best.box), *crop[1:]), best.box[2:] * crop.scale
        box = np.concatenate([middle - sides / 2, sides])
        rotation = (degrees + best.rotation + 180) % 360 - 180
        settled = abs(best.rotation) < _ENOUGH and _in_the_middle(best.box, frame, 0.2, 1.3)
        return replace(best, box=box, rotation=rotation), settled

    def _faces(self, part: _Part) -> Iterator[Detection]:
        found = self._found(part.bgr).astype(np.float64)
        found = found[np.isfinite(found).all(1) & (found[:, 2:4] > 0).all(1)]
        boxes = np.hstack([found[:, :2] / part.scale + part.corner, found[:, 2:4] / part.scale])
        for box, values in zip(boxes, found, strict=True):
            rotation = _rotation(values[4:14].reshape(5, 2), math.sqrt(values[2] * values[3]))
            yield Detection(box, KIND, rotation, float(values[14]))

    def _found(self, bgr: np.ndarray) -> np.ndarray:
        """A row a face: x, y, width, height, the two eyes, the nose, the corners of the mouth, and the score."""
        size = (bgr.shape[1], bgr.shape[0])
        if min(size) < _NARROWEST:
            return np.empty((0, 15), np.float32)
        if not hasattr(self._of_thread, "network"):
            score = min(self._score, _DOUBTFUL)
            with resources.as_file(resources.files(__package__) / "bundled" / _FILE) as bundled:
                path = str(bundled if self.path is None else self.path)
                self._of_thread.network = cv2.FaceDetectorYN.create(path, "", size, score, _SAME, _MOST)
        self._of_thread.network.setInputSize(size)
        faces = self._of_thread.network.detect(bgr)[1]
        return np.empty((0, 15), np.float32) if faces is None else faces


def _in_the_middle(box: np.ndarray, frame: Frame, apart: float = 0.4, times: float = 2.0) -> bool:
    """Whether a box (4,) of a patch is that of the face in its middle: apart by so much of its size, and so many times
    as large or small, at most."""
    away, ratio = np.abs(box_centre(box) - frame.middle).max(), box[2:].mean() / frame.face
    return bool(away < apart * frame.face and 1 / times < ratio < times)


def _rotation(points: np.ndarray, size: float) -> float:
    """How far a face is turned in the picture, in degrees, clockwise as seen, by its size in the network's pixels and
    its five points: the eyes, nose, and corners of the mouth, the left ones in the picture first. On profiles, whose
    eyes coincide, eyes and mouth tell."""
    across = points[1] - points[0]
    down = points[3:].mean(0) - points[:2].mean(0)
    x, y = across + [down[1], -down[0]]
    rotation = math.degrees(math.atan2(y, x)) * float(np.interp(size, _BELIEVED, _TURNED))
    return (rotation + 180) % 360 - 180


def _parts(bgr: np.ndarray, scale: float) -> Iterator[_Part]:
    """What the network looks at: the picture at the scale that the smallest faces need, and at coarser ones."""
    longest = max(bgr.shape[:2])
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
        part = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR)
    return _Part(np.ascontiguousarray(part), np.array([left, top]), np.array([size[0] / width, size[1] / height]))


def _tiles(length: int, scale: float) -> list[tuple[int, int]]:
    """Overlapping intervals that cover a number of pixels, each as long as ``_TILE`` for the network."""
    tile, shared = math.ceil(_TILE / scale), math.ceil(_SHARED / scale)
    if length <= tile:
        return [(0, length)]
    count = math.ceil((length - shared) / (tile - shared))
    firsts = np.linspace(0, length - tile, count).round().astype(int).tolist()
    return [(first, first + tile) for first in firsts]
