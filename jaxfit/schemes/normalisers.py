"""Normalisers: the lengths on a face that errors of its landmarks are divided by."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from jaxfit.errors import InputError
from jaxfit.schemes.scheme import Scheme


@dataclass(frozen=True)
class Normaliser:
    """A length on a face.

    Attributes:
        title: what it is, in words, for tables.
        ends: gives, for a scheme, the points whose means are its two ends; None if the scheme lacks them. Without it,
            ``length`` measures the annotated points.
        length: lengths (...) of points (..., L, D), NaN where unknown.
    """

    title: str
    ends: Callable[[Scheme], tuple[Sequence[int], Sequence[int]] | None] | None = None
    length: Callable[[np.ndarray], np.ndarray] = lambda points: _square_side(points)

    def known_of(self, scheme: Scheme) -> bool:
        """Whether faces of a scheme have it."""
        return self.ends is None or self.ends(scheme) is not None


def _outer_corners(scheme: Scheme) -> tuple[Sequence[int], Sequence[int]] | None:
    return scheme.outer_eyes and ((scheme.outer_eyes[0],), (scheme.outer_eyes[1],))


def _own_ends(scheme: Scheme) -> tuple[Sequence[int], Sequence[int]] | None:
    return scheme.ends and ((scheme.ends[0],), (scheme.ends[1],))


def _centroid_size(points: np.ndarray) -> np.ndarray:
    """The root of the sum of squared distances from the centroid; of missing points, those of the others' mean."""
    known = np.isfinite(points).all(-1)
    count = np.maximum(known.sum(-1), 1)
    kept = np.where(known[..., None], points, 0.0)
    centroid = kept.sum(-2) / count[..., None]
    squares = np.where(known, ((kept - centroid[..., None, :]) ** 2).sum(-1), 0.0)
    return np.asarray(np.sqrt(squares.sum(-1) / count * points.shape[-2]))


# By the names that the command line knows; a new one is a line here. The distance of the outer eye corners is our
# reading of Eq. 16's inter-ocular distance; the square does not vanish on profile faces. Boxes are those around the
# labelled points, of x and y in 3D too; the square is as large as the longest side, in 3D that of depths included.
NORMALISERS = {
    "outer": Normaliser("outer eye corners", _outer_corners),
    "pupil": Normaliser("pupil centres", lambda scheme: scheme.pupils),
    "box": Normaliser("bounding square"),
    "area": Normaliser("√(width × height) of the bounding box", length=lambda points: np.sqrt(_sides(points).prod(-1))),
    "diagonal": Normaliser("diagonal of the bounding box", length=lambda points: np.hypot.reduce(_sides(points), -1)),
    "size": Normaliser("centroid size", length=_centroid_size),
    "ends": Normaliser("the scheme's pair of points", _own_ends),
}


def default_normaliser(scheme: Scheme) -> str:
    """What the scheme says; else the outer eye corners of faces that have them; of all else the bounding square."""
    if scheme.normaliser is not None:
        return scheme.normaliser
    return "outer" if NORMALISERS["outer"].known_of(scheme) else "box"


def normaliser_length(truth: np.ndarray, scheme: Scheme, normaliser: str) -> np.ndarray:
    """The length, in pixels, that errors are divided by.

    Args:
        truth: (..., L, D) true landmarks in pixels, in 2D or 3D; NaN where unknown.
        scheme: what the landmarks mean.
        normaliser: one of ``NORMALISERS``.

    Returns:
        (...) lengths; NaN where a needed point is unknown or the length is zero.

    Raises:
        InputError: ``truth`` does not match the scheme, the normaliser is unknown, or the scheme lacks it.
    """
    if np.shape(truth)[-2:] not in ((scheme.count, 2), (scheme.count, 3)):
        raise InputError(
            f"landmarks of scheme {scheme.name} must be (..., {scheme.count}, 2) or (..., {scheme.count}, 3); "
            f"got {np.shape(truth)}"
        )
    known = [name for name, each in NORMALISERS.items() if each.known_of(scheme)]
    if normaliser not in known:
        raise InputError(
            f"scheme {scheme.name} has no normaliser {normaliser!r}; choose one that it has: {', '.join(known)}"
        )
    points, of_scheme = annotated(truth), NORMALISERS[normaliser].ends
    ends = None if of_scheme is None else of_scheme(scheme)
    if ends is None:
        lengths = NORMALISERS[normaliser].length(points)
    else:
        one, other = (points[..., list(end), :].mean(axis=-2) for end in ends)
        lengths = distance(one, other)
    return np.where(lengths > 0, lengths, np.nan)


def annotated(truth: np.ndarray) -> np.ndarray:
    """The points as float64, both coordinates NaN where one is not finite."""
    points = np.asarray(truth, dtype=np.float64)
    return np.where(np.isfinite(points).all(axis=-1, keepdims=True), points, np.nan)


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Euclidean distances (...) of points (..., D)."""
    # hypot, because the squares of a fit that ran away can overflow.
    return np.asarray(np.hypot.reduce(a - b, axis=-1))


def _square_side(points: np.ndarray) -> np.ndarray:
    return np.asarray(_sides(points, points.shape[-1]).max(axis=-1))


def _sides(points: np.ndarray, dimensions: int = 2) -> np.ndarray:
    """The sides (..., dimensions) of the boxes around points (..., L, D); 0 without a point."""
    unknown = np.isnan(points[..., :dimensions])
    highest = np.where(unknown, -np.inf, points[..., :dimensions]).max(axis=-2)
    lowest = np.where(unknown, np.inf, points[..., :dimensions]).min(axis=-2)
    return np.maximum(highest - lowest, 0.0)
