"""Where faces are in a picture: OpenCV's Haar cascades for frontal faces and for both profiles."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from jaxfit.data.boxes import box_centre
from jaxfit.data.images import to_grey

# Chosen on faces of LFPW, HELEN, YouTube Faces and AFLW. In larger pictures no more faces are found, only more that are
# none; equalising the histogram and the other frontal cascades find fewer, or more that are none.
_LONG_SIDE = 400
_SCALE_FACTOR = 1.1
_SURE, _UNSURE = 3, 1  # overlapping finds that make a face
_SMALLEST = 24
_SMALLEST_SHARE = 1 / 12
# The cascades want some background around a face, which pictures cut close to it lack.
_MARGIN = 0.1

_FRONTAL = "haarcascade_frontalface_alt2.xml"
_PROFILE = "haarcascade_profileface.xml"


@dataclass(frozen=True, eq=False)
class Detection:
    """A face found in a picture.

    Attributes:
        box: (4,) float64 x, y, width, height in pixels; may reach outside the picture.
        kind: which detector found it; boxes of different kinds sit differently around the same face.
    """

    box: np.ndarray
    kind: Literal["haar-frontal", "haar-profile"]


def detect_faces(image: np.ndarray) -> list[Detection]:
    """The faces in a picture, uint8 (H, W) grey or (H, W, 3) RGB, largest first; empty if none is found.

    Where no face is surely frontal, profiles are looked for as well and the largest of the less sure finds, if any, is
    the only one returned. Faces narrower than a twelfth of the picture's shorter side are not looked for.
    """
    small, back = _shrunk(to_grey(image))
    margin = round(_MARGIN * min(small.shape))
    padded = cv2.copyMakeBorder(small, margin, margin, margin, margin, cv2.BORDER_REPLICATE)
    smallest = max(_SMALLEST, round(_SMALLEST_SHARE * min(small.shape)))
    # The profile cascade takes three times as long as the frontal one and hardly adds to what that one is sure of.
    found = (
        _merged(_frontal(padded, smallest, _SURE))
        or _merged(_frontal(padded, smallest, _UNSURE) + _profile(padded, smallest, _UNSURE))[:1]
    )
    return [Detection((face.box - [margin, margin, 0, 0]) * back, face.kind) for face in found]


def best_match(detections: list[Detection], truth_box: np.ndarray) -> Detection | None:
    """The detection that found the face whose landmarks fill ``truth_box`` (4,), or None.

    Its centre lies in the box and its width is between half and twice the box's; of several the one that overlaps the
    box most.
    """
    matches = [
        face
        for face in detections
        if _holds(truth_box, box_centre(face.box)) and 0.5 <= face.box[2] / truth_box[2] <= 2
    ]
    return max(matches, key=lambda face: _overlap(face.box, truth_box), default=None)


@cache
def _cascade(name: str) -> cv2.CascadeClassifier:
    return cv2.CascadeClassifier(str(Path(cv2.__file__).parent / "data" / name))


def _shrunk(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The picture at the size for detection, and the factors (4,) that take its boxes back."""
    height, width = grey.shape
    shrink = min(1.0, _LONG_SIDE / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if shrink < 1 else grey
    return small, np.array([width / size[0], height / size[1]] * 2)


def _frontal(grey: np.ndarray, smallest: int, neighbours: int) -> list[Detection]:
    return [Detection(box, "haar-frontal") for box in _find(_FRONTAL, grey, smallest, neighbours)]


def _profile(grey: np.ndarray, smallest: int, neighbours: int) -> list[Detection]:
    # The cascade knows faces turned one way only.
    mirrored = _find(_PROFILE, cv2.flip(grey, 1), smallest, neighbours)
    mirrored[:, 0] = grey.shape[1] - mirrored[:, 0] - mirrored[:, 2]
    boxes = np.concatenate([_find(_PROFILE, grey, smallest, neighbours), mirrored])
    return [Detection(box, "haar-profile") for box in boxes]


def _find(name: str, grey: np.ndarray, smallest: int, neighbours: int) -> np.ndarray:
    """Boxes (N, 4) float64."""
    boxes = _cascade(name).detectMultiScale(grey, _SCALE_FACTOR, neighbours, minSize=(smallest, smallest))
    return np.array(boxes, np.float64).reshape(-1, 4)


def _merged(detections: list[Detection]) -> list[Detection]:
    """One detection a face, largest first: frontal before profile, then large before small, as eyes look like faces."""
    kept: list[Detection] = []
    for face in sorted(detections, key=lambda face: (face.kind == "haar-frontal", _area(face)), reverse=True):
        if not any(_same_face(face.box, other.box) for other in kept):
            kept.append(face)
    return sorted(kept, key=_area, reverse=True)


def _same_face(one: np.ndarray, other: np.ndarray) -> bool:
    return _overlap(one, other) > 0.3 or _holds(one, box_centre(other)) or _holds(other, box_centre(one))


def _overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union."""
    low, high = np.maximum(one[:2], other[:2]), np.minimum(one[:2] + one[2:], other[:2] + other[2:])
    shared = np.prod(np.maximum(high - low, 0))
    return float(shared / (np.prod(one[2:]) + np.prod(other[2:]) - shared))


def _holds(box: np.ndarray, point: np.ndarray) -> bool:
    return bool((point >= box[:2]).all() and (point <= box[:2] + box[2:]).all())


def _area(face: Detection) -> float:
    return float(np.prod(face.box[2:]))
