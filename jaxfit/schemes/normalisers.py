"""Normalisers: the lengths on a face that errors of its landmarks are divided by."""

import numpy as np

from jaxfit.errors import InputError
from jaxfit.schemes.scheme import Scheme

NORMALISER_TITLES = {
    "outer": "outer eye corners",
    "pupil": "pupil centres",
    "box": "bounding square",
}
NORMALISERS = tuple(NORMALISER_TITLES)


def normaliser_length(truth: np.ndarray, scheme: Scheme, normaliser: str) -> np.ndarray:
    """The length, in pixels, that errors are divided by.

    ``outer`` is the distance of the outer eye corners, our reading of Eq. 16's inter-ocular distance;
    ``pupil`` that of the pupil centres; ``box`` the side of the smallest upright square (or cube) around the annotated
    points, which does not vanish on profile faces.

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
    points = annotated(truth)
    if normaliser == "box":
        lengths = _square_side(points)
    else:
        left, right = _eye_indices(scheme, normaliser)
        lengths = distance(points[..., left, :].mean(axis=-2), points[..., right, :].mean(axis=-2))
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
    unknown = np.isnan(points)
    highest = np.where(unknown, -np.inf, points).max(axis=-2)
    lowest = np.where(unknown, np.inf, points).min(axis=-2)
    return np.asarray((highest - lowest).max(axis=-1))


def _eye_indices(scheme: Scheme, normaliser: str) -> list[list[int]]:
    """For the left and the right eye, the landmarks whose mean is the end of the normaliser."""
    eyes: dict[str, list[list[int]]] = {}
    if scheme.outer_eyes is not None:
        eyes["outer"] = [[corner] for corner in scheme.outer_eyes]
    if scheme.pupils is not None:
        eyes["pupil"] = [list(pupil) for pupil in scheme.pupils]
    if normaliser not in eyes:
        raise InputError(
            f"scheme {scheme.name} has no normaliser {normaliser!r}; "
            f"choose one that it has: {', '.join([*eyes, 'box'])}"
        )
    return eyes[normaliser]
