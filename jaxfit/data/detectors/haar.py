"""OpenCV's Haar cascades for frontal faces and for both profiles, which come with it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import local

import cv2
import numpy as np

from jaxfit.data.boxes import box_centre
from jaxfit.data.detectors.detector import Detection, Search, area, holds, largest_first, overlap
from jaxfit.data.pictures import Pixels, to_grey

FRONTAL, PROFILE = "haar-frontal", "haar-profile"

_SCALE_FACTOR = 1.1
_SURE, _UNSURE = 3, 1  # overlapping finds that make a face
_SEEN = 24  # pixels of the smallest face that is looked for, in a picture that is shrunk for it
# Of background, added where nothing is found: pictures cut close to a face lack what the cascades want around it.
_MARGIN = 0.1

_FRONTAL_FILE = "haarcascade_frontalface_alt2.xml"
_PROFILE_FILE = "haarcascade_profileface.xml"


# A cascade finds in one picture at a time: each thread has its own.
_OF_THREAD = local()


@dataclass(frozen=True)
class Haar:
    """Finds frontal faces, and where none is sure to be one, profiles.

    Of profiles and of frontal faces that are less sure the largest is the only one returned.

    Attributes:
        search: the smallest face; its score is not used.
    """

    search: Search = field(default_factory=Search)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Of the frontal and of the profile cascade."""
        return FRONTAL, PROFILE

    @property
    def colour(self) -> bool:
        """No: it looks at grey pictures."""
        return False

    @property
    def rough(self) -> bool:
        """Yes: a second pass saves failures, as ``scripts/detectors.py`` measures."""
        return True

    def __call__(self, image: Pixels) -> list[Detection]:
        """The faces in a picture, as in `jaxfit.data.pictures.to_eight_bits`, largest first."""
        small, back = _shrunk(to_grey(image), self.search)
        # The profile cascade takes three times as long as the frontal one and hardly adds to what that one is sure of.
        if not (found := _merged(_frontal(small, _SURE))):
            margin = round(_MARGIN * min(small.shape))
            padded = cv2.copyMakeBorder(small, margin, margin, margin, margin, cv2.BORDER_REPLICATE)
            found = (
                _merged(_frontal(padded, _SURE)) or _merged(_frontal(padded, _UNSURE) + _profile(padded, _UNSURE))[:1]
            )
            found = [replace(face, box=face.box - [margin, margin, 0, 0]) for face in found]
        return [replace(face, box=face.box * back) for face in found]


def _cascade(name: str) -> cv2.CascadeClassifier:
    if not hasattr(_OF_THREAD, name):
        setattr(_OF_THREAD, name, cv2.CascadeClassifier(str(Path(cv2.__file__).parent / "data" / name)))
    return getattr(_OF_THREAD, name)


def _shrunk(grey: np.ndarray, search: Search) -> tuple[np.ndarray, np.ndarray]:
    """The picture at the size for detection, and the factors (4,) that take its boxes back."""
    height, width = grey.shape
    scale = _SEEN / search.smallest_in(grey.shape)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    if size != (width, height):
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    return grey, np.array([width / size[0], height / size[1]] * 2)


def _frontal(grey: np.ndarray, neighbours: int) -> list[Detection]:
    return [Detection(box, FRONTAL) for box in _find(_FRONTAL_FILE, grey, neighbours)]


def _profile(grey: np.ndarray, neighbours: int) -> list[Detection]:
    # The cascade knows faces turned one way only.
    mirrored = _find(_PROFILE_FILE, cv2.flip(grey, 1), neighbours)
    mirrored[:, 0] = grey.shape[1] - mirrored[:, 0] - mirrored[:, 2]
    boxes = np.concatenate([_find(_PROFILE_FILE, grey, neighbours), mirrored])
    return [Detection(box, PROFILE) for box in boxes]


def _find(name: str, grey: np.ndarray, neighbours: int) -> np.ndarray:
    """Boxes (N, 4) float64."""
    boxes = _cascade(name).detectMultiScale(grey, _SCALE_FACTOR, neighbours, minSize=(_SEEN, _SEEN))
    return np.array(boxes, np.float64).reshape(-1, 4)


def _merged(detections: Sequence[Detection]) -> list[Detection]:
    """One detection a face, largest first: frontal before profile, then large before small, as eyes look like faces."""
    kept: list[Detection] = []
    for face in sorted(detections, key=lambda face: (face.kind == FRONTAL, area(face)), reverse=True):
        if not any(_same_face(face.box, other.box) for other in kept):
            kept.append(face)
    return largest_first(kept)


def _same_face(one: np.ndarray, other: np.ndarray) -> bool:
    return overlap(one, other) > 0.3 or holds(one, box_centre(other)) or holds(other, box_centre(one))
