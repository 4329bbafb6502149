"""What a landmark scheme is: what its points mean, to mirror, normalise and draw them.

Indices are 0-based. "Left" and "right" are those of the picture, not of the subject.
"""

from dataclasses import dataclass

import numpy as np

from jaxfit.errors import InputError


@dataclass(frozen=True)
class Scheme:
    """One way of labelling faces.

    Attributes:
        name: short name, stored in models.
        count: number of landmarks.
        outer_eyes: indices of the left and the right outer eye corner, or None if unknown.
        pupils: for the left and the right eye, the indices whose mean is the pupil, or None if unknown.
        mirror: ``mirror[i]`` is the index, in the original, of the point that becomes ``i`` in the mirrored picture;
            None if unknown.
        lines: polylines of indices that draw the face.
    """

    name: str
    count: int
    outer_eyes: tuple[int, int] | None = None
    pupils: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    mirror: tuple[int, ...] | None = None
    lines: tuple[tuple[int, ...], ...] = ()


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
