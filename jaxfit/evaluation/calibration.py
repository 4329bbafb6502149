"""How well probabilities predict what happens: ranking (AUROC) and calibration (expected calibration error)."""

import math
from dataclasses import dataclass

import numpy as np
import scipy

from jaxfit.errors import InputError

BINS = 15


@dataclass(frozen=True)
class Reliability:
    """Predicted probabilities beside how often the predictions came true, in bins of equal width from 0 to 1.

    Attributes:
        counts: (B,) predictions in each bin.
        predicted: (B,) the mean of their probabilities; NaN in an empty bin.
        observed: (B,) the share of them that came true; NaN in an empty bin.
    """

    counts: np.ndarray
    predicted: np.ndarray
    observed: np.ndarray

    @property
    def error(self) -> float:
        """Expected calibration error: the mean of |predicted - observed| over all predictions; NaN without any."""
        total = self.counts.sum()
        gaps = np.nan_to_num(np.abs(self.predicted - self.observed))
        return float((self.counts * gaps).sum() / total) if total else math.nan


def auroc(scores: np.ndarray, positive: np.ndarray) -> float:
    """Area under the ROC curve: how often a positive has a higher score than a negative; ties count half.

    Args:
        scores: (N,) any numbers.
        positive: (N,) bool.

    Returns:
        A share in [0, 1]; NaN without a positive or without a negative.

    Raises:
        InputError: not one score for each, or a score that is NaN.
    """
    scores, positive = _paired(scores, positive)
    hits = int(positive.sum())
    misses = len(positive) - hits
    if not hits or not misses:
        return math.nan
    above = scipy.stats.rankdata(scores)[positive].sum() - hits * (hits + 1) / 2
    return float(above / (hits * misses))


def reliability(probabilities: np.ndarray, happened: np.ndarray, bins: int = BINS) -> Reliability:
    """Probabilities (N,) beside what happened (N,), bool, in bins of equal width; a bin has its upper end.

    Raises:
        InputError: not one probability for each, one outside [0, 1], or no bins.
    """
    probabilities, happened = _paired(probabilities, happened)
    if bins < 1 or ((probabilities < 0) | (probabilities > 1)).any():
        raise InputError(f"expected probabilities in [0, 1] and at least one bin; got {bins} bins")
    which = np.clip(np.ceil(probabilities * bins).astype(int) - 1, 0, bins - 1)
    counts = np.bincount(which, minlength=bins)
    with np.errstate(invalid="ignore"):
        predicted, share = (
            np.bincount(which, weights=values, minlength=bins) / counts for values in (probabilities, happened)
        )
    return Reliability(counts, predicted, share)


def calibration_error(probabilities: np.ndarray, happened: np.ndarray, bins: int = BINS) -> float:
    """Expected calibration error of probabilities (N,) of what happened or not (N,); see `reliability`."""
    return reliability(probabilities, happened, bins).error


def _paired(scores: np.ndarray, flags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scores, flags = np.asarray(scores, np.float64), np.asarray(flags, bool)
    if scores.ndim != 1 or scores.shape != flags.shape or np.isnan(scores).any():
        raise InputError(f"expected a number, not NaN, for each of {flags.shape} flags; got {scores.shape}")
    return scores, flags
