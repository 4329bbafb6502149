"""Cumulative error distribution (CED) curves, the area under them and failure rates.

Everywhere here ``inf`` is a face that a method failed on and counts against it; NaN is a face that cannot be
measured and is left out. Without measurable faces the results are NaN.
"""

import math

import numpy as np

from jaxfit.errors import InputError

# The usual limit on 300-W, for errors divided by the distance of the outer eye corners.
LIMIT = 0.08


def measurable(errors: np.ndarray) -> np.ndarray:
    """The errors (N,) without those that are NaN, float64.

    Raises:
        InputError: the errors are not a vector.
    """
    values = _vector(errors)
    return values[~np.isnan(values)]


def ced(errors: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Share of faces with an error of at most each threshold (the CED curves of section 5).

    Args:
        errors: (N,) normalised errors.
        thresholds: (T,) in the units of the errors, in any order.

    Returns:
        (T,) shares in [0, 1].

    Raises:
        InputError: the errors are not a vector.
    """
    values = np.sort(measurable(errors))
    if not values.size:
        return np.full(np.shape(thresholds), np.nan)
    return np.searchsorted(values, thresholds, side="right") / values.size


def auc(errors: np.ndarray, limit: float = LIMIT) -> float:
    """Area under the CED from 0 to ``limit``, divided by ``limit``: 1 when every error is 0.

    Args:
        errors: (N,) normalised errors.
        limit: where the curve ends, in the units of the errors.

    Raises:
        InputError: the errors are not a vector or the limit is not positive.
    """
    return _mean(areas(errors, limit))


def areas(errors: np.ndarray, limit: float = LIMIT) -> np.ndarray:
    """What each face contributes to ``auc``, which is their mean: (N,) in [0, 1]; NaN where the error is.

    Exact: the CED is a mean of steps, one at each error e, and the area under one is max(0, limit - e).

    Raises:
        InputError: the errors are not a vector or the limit is not positive.
    """
    _check_limit(limit)
    return np.maximum(0.0, 1.0 - _vector(errors) / limit)


def failure_rate(errors: np.ndarray, limit: float = LIMIT) -> float:
    """Share of faces with an error above ``limit``.

    Args:
        errors: (N,) normalised errors.
        limit: the largest error that is no failure, in the units of the errors.

    Raises:
        InputError: the errors are not a vector or the limit is not positive.
    """
    return _mean(failures(errors, limit))


def failures(errors: np.ndarray, limit: float = LIMIT) -> np.ndarray:
    """Whether each face fails, which ``failure_rate`` is the mean of: (N,) 1 or 0; NaN where the error is.

    Raises:
        InputError: the errors are not a vector or the limit is not positive.
    """
    _check_limit(limit)
    values = _vector(errors)
    return np.where(np.isnan(values), np.nan, values > limit)


def _vector(errors: np.ndarray) -> np.ndarray:
    values = np.asarray(errors, dtype=np.float64)
    if values.ndim != 1:
        raise InputError(f"errors must be one number a face, (faces,); got {values.shape}")
    return values


def _mean(values: np.ndarray) -> float:
    """Of those that are not NaN."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else math.nan


def _check_limit(limit: float) -> None:
    if not 0 < limit < math.inf:
        raise InputError(f"the error limit must be a positive number; got {limit}")
