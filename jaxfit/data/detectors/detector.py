"""The seam for face detectors: what they find, and what is asked of one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from jaxfit.data.boxes import box_centre


@dataclass(frozen=True, eq=False)
class Detection:
    """A face found in a picture.

    Attributes:
        box: (4,) float64 x, y, width, height in pixels; may reach outside the picture.
        kind: which detector found it; boxes of different kinds sit differently around the same face.
    """

    box: np.ndarray
    kind: str


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
        """Whether its boxes lie around faces so differently that a second pass of the cascade pays."""
        ...

    def __call__(self, image: np.ndarray) -> list[Detection]:
        """The faces in a picture, uint8 (H, W) grey or (H, W, 3) RGB, largest first; empty if none is found."""
        ...


def best_match(detections: Sequence[Detection], truth_box: np.ndarray) -> Detection | None:
    """The detection that found the face whose landmarks fill ``truth_box`` (4,), or None.

    Its centre lies in the box and its width is between half and twice the box's; of several the one that overlaps the
    box most.
    """
    matches = [
        face for face in detections if holds(truth_box, box_centre(face.box)) and 0.5 <= face.box[2] / truth_box[2] <= 2
    ]
    return max(matches, key=lambda face: overlap(face.box, truth_box), default=None)


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
