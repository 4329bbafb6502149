"""Summaries of errors over a set of faces, and tests of whether two methods differ (section 5)."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from jaxfit.evaluation.curves import LIMIT, auc, failure_rate, measurable
from jaxfit.exceptions import InputError


@dataclass(frozen=True)
class Summary:
    """What is reported of one method on one set of faces; errors are shares of the normaliser.

    Attributes:
        faces: all faces, ``measured + failed + unmeasured``.
        measured: faces with a finite error.
        failed: faces without a fit (error ``inf``).
        unmeasured: faces whose error is unknown (NaN), left out of everything below.
        mean: mean of the finite errors.
        ci95: half the width of the 95 % confidence interval of that mean.
        median: median of the finite and infinite errors.
        auc: area under the CED up to ``limit``, failures included.
        failure: share of errors above ``limit``, failures included.
        limit: of ``auc`` and ``failure``.
    """

    faces: int
    measured: int
    failed: int
    unmeasured: int
    mean: float
    ci95: float
    median: float
    auc: float
    failure: float
    limit: float

    def as_json(self) -> dict[str, object]:
        """The summary for a JSON file; None where a number is not finite, as JSON has no word for it."""
        return {
            "faces": self.faces,
            "fitted": self.measured,
            "undetected": self.failed,
            "unmeasured": self.unmeasured,
            "nmed": {
                "mean": finite_or_none(self.mean),
                "ci95": finite_or_none(self.ci95),
                "median": finite_or_none(self.median),
            },
            f"auc_{self.limit:g}": finite_or_none(self.auc),
            f"failure_{self.limit:g}": finite_or_none(self.failure),
        }


def summarise(errors: np.ndarray, limit: float = LIMIT) -> Summary:
    """Summary of errors (N,): ``inf`` for a failed fit, NaN for a face that cannot be measured.

    What too few faces leave undefined is NaN: everything without faces, ``ci95`` with a single one.

    Raises:
        InputError: the errors are not a vector or the limit is not positive.
    """
    values = measurable(errors)
    finite = values[np.isfinite(values)]
    return Summary(
        faces=len(errors),
        measured=finite.size,
        failed=values.size - finite.size,
        unmeasured=len(errors) - values.size,
        mean=float(finite.mean()) if finite.size else math.nan,
        ci95=_mean_ci95(finite),
        median=float(np.median(values)) if values.size else math.nan,
        auc=auc(values, limit),
        failure=failure_rate(values, limit),
        limit=limit,
    )


def rank_sum(a: np.ndarray, b: np.ndarray) -> float:
    """Two-sided p-value of the Wilcoxon rank-sum (Mann-Whitney) test: do errors (N,) and (M,) differ?

    Only ranks count, so ``inf`` is simply the worst; NaN is left out. Exact for small samples without ties,
    else the normal approximation with a correction for ties. NaN when a sample is empty.

    Raises:
        InputError: a sample is not a vector.
    """
    a, b = measurable(a), measurable(b)
    if not (a.size and b.size):
        return math.nan
    ranks = stats.rankdata(np.concatenate([a, b]))
    if np.ptp(ranks) == 0:
        return 1.0  # All are equal: the variance of the statistic is zero.
    return float(stats.mannwhitneyu(ranks[: a.size], ranks[a.size :]).pvalue)


def signed_rank(a: np.ndarray, b: np.ndarray) -> float:
    """Two-sided p-value of the Wilcoxon signed-rank test: do errors (N,) of the same faces differ?

    Pairs of equal errors, two failures included, are dropped as in Wilcoxon's test; a failure of one method
    is the largest difference. Pairs with a NaN are left out. 1 when all pairs are equal, NaN when there are
    none.

    Raises:
        InputError: the samples are not vectors of one length.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise InputError(f"paired errors must both be (faces,), of the same faces; got {a.shape} and {b.shape}")
    paired = ~(np.isnan(a) | np.isnan(b))
    differs = paired & (a != b)
    if not differs.any():
        return 1.0 if paired.any() else math.nan
    difference = a[differs] - b[differs]
    # The test sees signed ranks only; ranking here keeps infinities out of its arithmetic.
    return float(stats.wilcoxon(np.sign(difference) * stats.rankdata(np.abs(difference))).pvalue)


def finite_or_none(value: float) -> float | None:
    """The value for a JSON file, which has no word for infinity and NaN."""
    return value if math.isfinite(value) else None


def _mean_ci95(values: np.ndarray) -> float:
    """Half-width of the Student t interval of the mean of (N,) finite values; NaN below two."""
    if values.size < 2:
        return math.nan
    return float(stats.t.ppf(0.975, values.size - 1) * values.std(ddof=1) / math.sqrt(values.size))
