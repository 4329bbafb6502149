"""What a landmark scheme is: what its points mean, to mirror, normalise and draw them.

Indices are 0-based. "Left" and "right" are those of the picture, not of the subject.
"""

from dataclasses import dataclass
from itertools import chain

import numpy as np

from jaxfit.errors import InputError

LONGEST = 100  # letters of a name


def is_name(value: object) -> bool:
    """Whether a value is a text that can be a name in files, tables and messages."""
    return isinstance(value, str) and 0 < len(value) <= LONGEST and value.isprintable() and value == value.strip()


@dataclass(frozen=True)
class Scheme:
    """One way of labelling faces, or other objects.

    Attributes:
        name: short name, stored in models.
        count: number of landmarks.
        outer_eyes: indices of the left and the right outer eye corner, or None if unknown.
        pupils: for the left and the right eye, the indices whose mean is the pupil, or None if unknown.
        mirror: ``mirror[i]`` is the index, in the original, of the point that becomes ``i`` in the mirrored picture;
            None if unknown.
        lines: polylines of indices that draw the face.
        names: what the points are called; empty if they are only numbered.
        normaliser: what errors are divided by unless a normaliser is given, one of ``NORMALISERS``; None: see
            `jaxfit.schemes.normalisers.default_normaliser`.
        ends: two points whose distance is the normaliser ``ends``, or None.
        unit: of lengths, where a picture's scale is known, such as ``mm``; empty if unknown.
    """

    name: str
    count: int
    outer_eyes: tuple[int, int] | None = None
    pupils: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    mirror: tuple[int, ...] | None = None
    lines: tuple[tuple[int, ...], ...] = ()
    names: tuple[str, ...] = ()
    normaliser: str | None = None
    ends: tuple[int, int] | None = None
    unit: str = ""

    def __post_init__(self) -> None:
        of_points = [*chain.from_iterable(self.lines), *(self.mirror or ()), *(self.ends or ())]
        if self.count < 0 or not all(0 <= index < self.count for index in of_points):
            raise InputError(f"scheme {self.name}: expected points 1 to {self.count} in lines, pairs and ends")
        if self.mirror is not None and any(
            len(self.mirror) != self.count or self.mirror[other] != index for index, other in enumerate(self.mirror)
        ):
            raise InputError(f"scheme {self.name}: expected each of {self.count} points in one mirror pair at most")
        if self.names and not (len(self.names) == len({*self.names}) == self.count):
            raise InputError(f"scheme {self.name}: expected {self.count} different names of points")
        if odd := next((name for name in self.names if not is_name(name)), None):
            raise InputError(
                f"scheme {self.name}: expected names of points that can be printed, of up to {LONGEST} letters; "
                f"got {odd!r}"
            )
        if self.ends is not None and self.ends[0] == self.ends[1]:
            raise InputError(f"scheme {self.name}: expected two different points as ends")

    def point_name(self, index: int) -> str:
        """What a point is called: its name, or its number, from 1."""
        return self.names[index] if self.names else str(index + 1)


def mirror_order(scheme: Scheme) -> tuple[int, ...]:
    """``scheme.mirror``.

    Raises:
        InputError: the scheme does not say which points are mirror images of each other.
    """
    if scheme.mirror is None:
        raise InputError(f"scheme {scheme.name} has no mirror order; train without mirrored pictures")
    return scheme.mirror


def mirrored(landmarks: np.ndarray, width: int | float, scheme: Scheme) -> np.ndarray:
    """Landmarks (..., L, 2) of the picture flipped left to right; ``width`` is the picture's, in pixels.

    Raises:
        InputError: the scheme does not say which points are mirror images of each other.
    """
    flipped = np.asarray(landmarks)[..., list(mirror_order(scheme)), :].copy()
    flipped[..., 0] = width - 1 - flipped[..., 0]
    return flipped
