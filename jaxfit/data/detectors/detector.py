"""The seam for face detectors: what they find, what is asked of one, and how finds of one face are merged."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Protocol, runtime_checkable

import numpy as np

from jaxfit.data.boxes import box_centre
from jaxfit.data.pictures import Pixels, to_eight_bits
from jaxfit.errors import InputError

_SMALLEST = 24.0  # pixels of the smallest faces that are looked for by default,
_SMALLEST_SHARE = 1 / 60  # or this share of a picture's size, the root of its area, whichever is more


@dataclass(frozen=True, eq=False)
class Detection:
    """A face found in a picture.

    Attributes:
        box: (4,) float64 x, y, width, height in pixels; may reach outside the picture.
        kind: which detector found it; boxes of different kinds sit differently around the same face.
        rotation: how far the face is turned in the picture, in degrees, clockwise as seen; 0 if the detector does not
            say.
        score: how sure the detector is, comparable among its own finds only.
    """

    box: np.ndarray
    kind: str
    rotation: float = 0.0
    score: float = 1.0


@dataclass(frozen=True)
class Search:
    """How faces are looked for.

    Attributes:
        smallest: width in pixels of the smallest faces to find; None is 24, or in large pictures 1/60 of the root of
            their area. Half the width takes four times as long.
        score: the least score, in (0, 1], with which a find counts as a face, for detectors that score their finds;
            None is what suits the detector.
        any_rotation: also look at the picture turned by 90, 180 and 270 degrees, which takes four times as long. YuNet
            finds most turned faces without it, but takes a face that is upside down for an upright one.

    Raises:
        InputError: a number out of range.
    """

    smallest: float | None = None
    score: float | None = None
    any_rotation: bool = False

    def __post_init__(self) -> None:
        if self.smallest is not None and not (math.isfinite(self.smallest) and self.smallest >= 8):
            raise InputError(f"smallest: expected a face width of 8 pixels or more; got {self.smallest}")
        if self.score is not None and not 0 < self.score <= 1:
            raise InputError(f"score: expected a number above 0 and up to 1; got {self.score}")

    def smallest_in(self, shape: Sequence[int], least: float = _SMALLEST) -> float:
        """The width of the smallest faces that are looked for in a picture (H, W, …), in its pixels."""
        return max(least, _SMALLEST_SHARE * math.sqrt(shape[0] * shape[1])) if self.smallest is None else self.smallest


@runtime_checkable
class Detector(Protocol):
    """Finds faces in pictures; may be called in several threads at once."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Of the boxes that it draws."""
        ...

    @property
    def colour(self) -> bool:
        """Whether it looks at colours; pictures are read in grey for detectors that do not."""
        ...

    @property
    def rough(self) -> bool:
        """Whether its boxes vary so much that a second pass of the cascade is worth its time."""
        ...

    def __call__(self, image: np.ndarray) -> list[Detection]:
        """The faces in a picture, uint8 (H, W) grey or (H, W, 3) RGB, largest first; empty if none is found."""
        ...


@dataclass(frozen=True)
class DetectorEntry:
    """A detector in the registry: how it is made, and what is known of it before, or where it is not installed.

    Attributes:
        make: makes it of how faces are looked for.
        kinds: of the boxes that it draws, as in `Detector`.
        rough: as in `Detector`.
        rotates: whether it heeds ``Search.any_rotation`` itself; for all others the picture is turned.
        unused: what of `Search` means nothing to it.
        make_of_file: makes it of a file, too, as ``NAME:FILE`` asks for; None: it takes none.
        package: that it needs beside those that come with jaxfit; empty: none.
    """

    make: Callable[[Search], Detector]
    kinds: tuple[str, ...]
    rough: bool = False
    rotates: bool = False
    unused: tuple[str, ...] = ()
    make_of_file: Callable[[Search, str], Detector] | None = None
    package: str = ""

    @property
    def installed(self) -> bool:
        """Whether what it needs is there."""
        return not self.package or find_spec(self.package) is not None


@dataclass(frozen=True)
class AnyRotation:
    """A detector that also looks at the picture turned by 90, 180 and 270 degrees, and merges what it finds.

    Attributes:
        detector: that looks.
    """

    detector: Detector

    @property
    def kinds(self) -> tuple[str, ...]:
        """Those of the detector."""
        return self.detector.kinds

    @property
    def colour(self) -> bool:
        """As the detector."""
        return self.detector.colour

    @property
    def rough(self) -> bool:
        """As the detector's."""
        return self.detector.rough

    def __call__(self, image: Pixels) -> list[Detection]:
        """The faces in a picture, turned to any side, largest first."""
        image, found = to_eight_bits(image), []
        for quarters in range(4):
            turned = np.ascontiguousarray(np.rot90(image, quarters))  # counter-clockwise
            found += [turned_back(face, quarters, image.shape) for face in self.detector(turned)]
        return merged(found)


def turned_back(face: Detection, quarters: int, shape: Sequence[int]) -> Detection:
    """A face of a picture that was turned counter-clockwise by some quarters, as it lies in the picture (H, W, …)
    itself."""
    (x, y, width, height), (rows, columns) = face.box.tolist(), shape[:2]
    if quarters == 1:
        box = [columns - y - height, x, height, width]
    elif quarters == 2:
        box = [columns - x - width, rows - y - height, width, height]
    elif quarters == 3:
        box = [y, rows - x - width, height, width]
    else:
        box = [x, y, width, height]
    rotation = (face.rotation + 90 * quarters + 180) % 360 - 180
    return replace(face, box=np.array(box, np.float64), rotation=rotation)


def best_match(detections: Sequence[Detection], truth_box: np.ndarray) -> Detection | None:
    """The detection that found the face whose landmarks fill ``truth_box`` (4,), or None.

    Its centre lies in the box and its width is between half and twice the box's; of several the one that overlaps the
    box most.
    """
    matches = [
        face for face in detections if holds(truth_box, box_centre(face.box)) and 0.5 <= face.box[2] / truth_box[2] <= 2
    ]
    return max(matches, key=lambda face: overlap(face.box, truth_box), default=None)


def merged(detections: Iterable[Detection], same: float = 0.3) -> list[Detection]:
    """One detection a face, largest first: of those that overlap (IoU) by more than ``same`` the one with the best
    score."""
    kept: list[Detection] = []
    for face in sorted(detections, key=lambda face: face.score, reverse=True):
        if not any(overlap(face.box, other.box) > same for other in kept):
            kept.append(face)
    return largest_first(kept)


def largest_first(detections: Sequence[Detection]) -> list[Detection]:
    """Sorted by area."""
    return sorted(detections, key=area, reverse=True)


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of boxes (4,)."""
    low, high = np.maximum(one[:2], other[:2]), np.minimum(one[:2] + one[2:], other[:2] + other[2:])
    shared = np.prod(np.maximum(high - low, 0))
    return float(shared / (np.prod(one[2:]) + np.prod(other[2:]) - shared))


def holds(box: np.ndarray, point: np.ndarray) -> bool:
    """Whether a point (2,) lies in a box (4,)."""
    return bool((point >= box[:2]).all() and (point <= box[:2] + box[2:]).all())


def area(face: Detection) -> float:
    """Of its box, in pixels."""
    return float(np.prod(face.box[2:]))
