"""How far fitted landmarks are from the true ones, in 2D and 3D: normalised mean Euclidean distance (NMED, Eq. 16)."""

import numpy as np

from jaxfit.errors import InputError
from jaxfit.schemes.normalisers import annotated, default_normaliser, distance, normaliser_length
from jaxfit.schemes.scheme import Scheme


def nmed(fitted: np.ndarray, truth: np.ndarray, scheme: Scheme, normaliser: str | None = None) -> np.ndarray:
    """Normalised mean Euclidean distance of each face over its annotated landmarks, Eq. 16.

    Args:
        fitted: (N, L, D) fitted landmarks in pixels, in 2D or 3D; NaN if the face was not found or the picture not
            read.
        truth: (N, L, D) true landmarks in pixels; NaN where unknown.
        scheme: what the landmarks mean.
        normaliser: one of ``NORMALISERS``; None takes `default_normaliser`.

    Returns:
        (N,) errors as a share of the normaliser. ``inf`` is a failure: the fit lacks an annotated landmark.
        NaN is a face that cannot be measured, because its normaliser is unknown; whatever the fit, so that
        all methods are measured on the same faces.

    Raises:
        InputError: the arrays are not both (N, L, D) with the scheme's L, or see ``normaliser_length``.
    """
    if np.ndim(truth) != 3 or np.shape(fitted) != np.shape(truth):
        raise InputError(
            f"fitted and true landmarks must both be (faces, {scheme.count}, 2) or both (faces, {scheme.count}, 3); "
            f"got {np.shape(fitted)} and {np.shape(truth)}"
        )
    lengths = normaliser_length(truth, scheme, normaliser or default_normaliser(scheme))
    points = annotated(truth)
    counted = np.isfinite(points[..., 0])
    distances = np.where(counted, distance(np.asarray(fitted, dtype=np.float64), points), 0.0)
    means = distances.sum(axis=-1) / np.maximum(counted.sum(axis=-1), 1)
    return np.where(np.isnan(means), np.inf, means) / lengths
