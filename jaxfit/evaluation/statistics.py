"""Summaries of errors over a set of faces, how sure they are, and tests of whether methods differ (section 5)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from jaxfit.errors import InputError
from jaxfit.evaluation.curves import LIMIT, areas, auc, failure_rate, failures, measurable

# The subject of each face; None if each face is a subject of its own.
Subjects = Sequence[str] | np.ndarray | None

# Draws of the bootstrap that are held in memory at once, with what is drawn some 25 MB.
_DRAWS = 2**20
SAMPLES = 2000
_ALL_SIGNS = 13  # pairs with equal differences up to which the signed-rank test goes through all signs, as SciPy does


@dataclass(frozen=True)
class Summary:
    """What is reported of one method on one set of faces; errors are shares of the normaliser.

    Attributes:
        faces: all faces, ``measured + failed + unmeasured``.
        measured: faces with a finite error.
        failed: faces without a fit (error ``inf``).
        unmeasured: faces whose error is unknown (NaN), left out of everything below.
        mean: mean of the finite errors.
        ci95: half the width of the 95 % confidence interval of that mean, wide where there are few subjects.
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


def summarise(errors: np.ndarray, limit: float = LIMIT, subjects: Subjects = None) -> Summary:
    """Summary of errors (N,): ``inf`` for a failed fit, NaN for a face that cannot be measured.

    Pictures of one person are not independent: with ``subjects``, ``ci95`` is that of a mean over clusters. What too
    few faces leave undefined is NaN: everything without faces, ``ci95`` with a single subject.

    Raises:
        InputError: the errors are not a vector, the limit is not positive, or there is not one subject a face.
    """
    values = measurable(errors)
    finite = values[np.isfinite(values)]
    return Summary(
        faces=len(errors),
        measured=finite.size,
        failed=values.size - finite.size,
        unmeasured=len(errors) - values.size,
        mean=float(finite.mean()) if finite.size else math.nan,
        ci95=_ratio_ci95(finite, np.ones(finite.size), _owners(subjects, np.isfinite(errors))),
        median=float(np.median(values)) if values.size else math.nan,
        auc=auc(values, limit),
        failure=failure_rate(values, limit),
        limit=limit,
    )


def both_measured(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (M,) of two methods on those of the same N faces that both could measure.

    Args:
        a: (N,) errors, NaN where not measured.
        b: (N,) those of the other method.
    """
    measured = ~(np.isnan(a) | np.isnan(b))
    return a[measured], b[measured]


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
    ranks = scipy.stats.rankdata(np.concatenate([a, b]))
    if np.ptp(ranks) == 0:
        return 1.0  # All are equal: the variance of the statistic is zero.
    return float(scipy.stats.mannwhitneyu(ranks[: a.size], ranks[a.size :]).pvalue)


def signed_rank(
    a: np.ndarray, b: np.ndarray, subjects: Subjects = None, *, alternative: Literal["two-sided", "less"] = "two-sided"
) -> float:
    """P-value of the Wilcoxon signed-rank test: do errors (N,) of the same faces differ, or are the first ones less?

    Pairs of equal errors, two failures included, are dropped as in Wilcoxon's test; a failure of one method
    is the largest difference. Pairs with a NaN are left out. 1 when all pairs are equal, NaN when there are
    none. Pictures of one person are not independent: with ``subjects``, the pairs are people's mean errors.

    Raises:
        InputError: the samples are not vectors of one length, or there is not one subject a face.
    """
    ranks = _signed_ranks(a, b, subjects)
    if ranks is None or not len(ranks):
        return math.nan if ranks is None else 1.0
    if len(ranks) <= _ALL_SIGNS and len(np.unique(np.abs(ranks))) < len(ranks):
        return _exact_p(ranks, alternative)
    return float(scipy.stats.wilcoxon(ranks, alternative=alternative).pvalue)


def _exact_p(ranks: np.ndarray, alternative: str) -> float:
    """What SciPy finds, too, but in seconds: the p-value of signed ranks (M,) among all signs that they may have."""
    signs = np.arange(2 ** len(ranks))[:, None] >> np.arange(len(ranks)) & 1
    sums, own = signs @ np.abs(ranks), ranks[ranks > 0].sum()
    less, more = float((sums <= own).mean()), float((sums >= own).mean())
    return less if alternative == "less" else min(1.0, 2 * min(less, more))


def rank_biserial(a: np.ndarray, b: np.ndarray, subjects: Subjects = None) -> float:
    """The effect size that belongs to `signed_rank`, of errors (N,) of the same faces: the matched-pairs rank-biserial
    correlation (Kerby, 2014).

    It is the share of the ranks that speak for the first errors being larger less that of those that speak against it:
    1 if they are larger in all pairs, -1 if they are smaller in all, 0 if neither, or all are equal; NaN without pairs.

    Raises:
        InputError: as `signed_rank`.
    """
    ranks = _signed_ranks(a, b, subjects)
    if ranks is None or not len(ranks):
        return math.nan if ranks is None else 0.0
    return float(ranks.sum() / np.abs(ranks).sum())


def _signed_ranks(a: np.ndarray, b: np.ndarray, subjects: Subjects) -> np.ndarray | None:
    """The ranks (M,) of the differences of the pairs that differ, with their signs; None if there is no pair."""
    a, b = _paired(a, b)
    unmeasured = np.isnan(a) | np.isnan(b)
    if unmeasured.all():
        return None
    if subjects is not None:
        silent = unmeasured | (np.isinf(a) & np.isinf(b))
        a, b = (subject_means(np.where(silent, np.nan, errors), subjects) for errors in (a, b))
    differs = ~(np.isnan(a) | np.isnan(b)) & (a != b)
    difference = a[differs] - b[differs]
    # Ranks keep infinities out of the arithmetic of tests.
    return np.asarray(np.sign(difference) * scipy.stats.rankdata(np.abs(difference)))


def subject_means(errors: np.ndarray, subjects: Subjects) -> np.ndarray:
    """(S,) the mean error of each subject that has errors, of errors (N,): NaN is left out, ``inf`` makes it ``inf``.

    Raises:
        InputError: the errors are not a vector, or there is not one subject a face.
    """
    values = measurable(errors)
    owners = _owners(subjects, ~np.isnan(errors))
    return np.bincount(owners, values) / np.bincount(owners)


def relative_difference(errors: np.ndarray, baseline: np.ndarray, subjects: Subjects = None) -> tuple[float, float]:
    """By what share the mean of errors (N,) differs from a baseline's (N,), and half its 95 % confidence interval.

    Over the faces that both fitted. What too few subjects, or a mean of zero, leave undefined is NaN.

    Raises:
        InputError: the errors are not vectors of one length, or there is not one subject a face.
    """
    errors, baseline = _paired(errors, baseline)
    both = np.isfinite(errors) & np.isfinite(baseline)
    errors, baseline, owners = errors[both], baseline[both], _owners(subjects, both)
    if not baseline.any():
        return math.nan, math.nan
    return float(errors.sum() / baseline.sum()) - 1, _ratio_ci95(errors, baseline, owners)


def holm(p_values: np.ndarray) -> np.ndarray:
    """Holm's step-down adjustment of the p-values of several tests: which hold when all are looked at.

    Rejecting where the adjusted value is at most α errs on any true hypothesis with a probability of at most α, however
    the tests depend on each other.

    Args:
        p_values: (K,) of K tests; NaN is a test that was not made, and does not count.

    Returns:
        (K,) adjusted p-values, NaN where they were.

    Raises:
        InputError: not a vector of numbers in [0, 1] or NaN.
    """
    p_values = np.asarray(p_values, dtype=np.float64)
    tested = ~np.isnan(p_values)
    if p_values.ndim != 1 or (p_values[tested] < 0).any() or (p_values[tested] > 1).any():
        raise InputError(f"expected a vector of p-values in [0, 1], NaN where there is none; got {p_values}")
    ascending = np.flatnonzero(tested)[np.argsort(p_values[tested])]
    hypotheses_left = np.arange(len(ascending), 0, -1)
    adjusted = np.full_like(p_values, np.nan)
    adjusted[ascending] = np.minimum(np.maximum.accumulate(hypotheses_left * p_values[ascending]), 1.0)
    return adjusted


def bootstrap_ci(
    values: np.ndarray,
    subjects: Subjects = None,
    *,
    confidence: float = 0.95,
    samples: int = SAMPLES,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap confidence interval of the mean of values (N,), one a face.

    Pictures of one person are not independent. With ``subjects``, whole subjects are drawn, each with all its faces, as
    often as there are subjects; the mean is that of all faces drawn.

    Args:
        values: (N,) finite; NaN is a face that is left out.
        subjects: who is seen on each of the N faces; None if each is a person of its own.
        confidence: with which the interval shall hold the mean, in (0, 1).
        samples: how many samples are drawn.
        seed: of the draws.

    Returns:
        The lower and the upper end; both NaN with fewer than two subjects.

    Raises:
        InputError: the values are not a vector or infinite, there is not one subject a face, or an option is out of
            range.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 1 or np.isinf(values).any():
        raise InputError(
            f"expected one finite number a face, (faces,), or NaN to leave it out; got {values.shape} with "
            f"{int(np.isinf(values).sum())} infinite: of errors, take median_ci, auc_ci and failure_ci"
        )
    known = ~np.isnan(values)
    values, owners = values[known], _owners(subjects, known)
    faces, totals = np.bincount(owners), np.bincount(owners, values)
    return _percentiles(
        lambda drawn: totals[drawn].sum(axis=1) / faces[drawn].sum(axis=1),
        (len(faces), len(faces)),
        (confidence, samples, seed),
    )


def _percentiles(
    statistic: Callable[[np.ndarray], np.ndarray], sizes: tuple[int, int], how: tuple[float, int, int]
) -> tuple[float, float]:
    """The percentile bootstrap interval of a statistic of drawn subjects (samples, S), as (samples,) values.

    Args:
        statistic: of the numbers of the subjects that were drawn.
        sizes: how many subjects there are, and how many numbers a sample takes in memory.
        how: confidence, samples and seed.
    """
    (subjects, size), (confidence, samples, seed) = sizes, how
    if not (0 < confidence < 1 and samples >= 1 and seed >= 0):
        raise InputError(
            "expected 0 < confidence < 1, at least one sample and a seed of 0 or more; got "
            f"{confidence}, {samples} and {seed}"
        )
    if subjects < 2:
        return math.nan, math.nan
    rng = np.random.default_rng(seed)
    values = np.empty(samples)
    at_once = max(1, _DRAWS // size)
    for first in range(0, samples, at_once):
        drawn = rng.integers(subjects, size=(min(at_once, samples - first), subjects))
        values[first : first + at_once] = statistic(drawn)
    # Of infinite values, the nearest one: between two there is nothing.
    method: Literal["linear", "nearest"] = "linear" if np.isfinite(values).all() else "nearest"
    low, high = np.quantile(values, [(1 - confidence) / 2, (1 + confidence) / 2], method=method)
    return float(low), float(high)


def median_ci(
    errors: np.ndarray,
    subjects: Subjects = None,
    *,
    confidence: float = 0.95,
    samples: int = SAMPLES,
    seed: int = 0,
) -> tuple[float, float]:
    """Confidence interval of the median of errors (N,), in which ``inf`` is the worst of errors; see ``bootstrap_ci``
    for the arguments.

    Raises:
        InputError: the errors are not a vector, or see ``bootstrap_ci``.
    """
    values = measurable(errors)
    owners = _owners(subjects, ~np.isnan(errors))
    order = np.argsort(values, kind="stable")
    ascending, owner = values[order], owners[order]
    subjects_drawn = len(np.bincount(owners))

    def medians(drawn: np.ndarray) -> np.ndarray:
        rows = np.arange(len(drawn))[:, None]
        times = np.bincount((rows * subjects_drawn + drawn).ravel(), minlength=len(drawn) * subjects_drawn)
        # How many of the drawn faces are up to each one: the middle ones of the sample are found there.
        up_to = times.reshape(len(drawn), -1)[:, owner].cumsum(axis=1)
        below, above = (up_to[:, -1] - 1) // 2, up_to[:, -1] // 2
        low, high = (ascending[(up_to <= place[:, None]).sum(axis=1)] for place in (below, above))
        return (low + high) / 2

    return _percentiles(medians, (subjects_drawn, max(len(values), 1)), (confidence, samples, seed))


def auc_ci(
    errors: np.ndarray,
    limit: float = LIMIT,
    subjects: Subjects = None,
    *,
    confidence: float = 0.95,
    samples: int = SAMPLES,
    seed: int = 0,
) -> tuple[float, float]:
    """Confidence interval of ``auc`` of errors (N,); see ``bootstrap_ci`` for the arguments.

    Raises:
        InputError: the errors are not a vector, the limit is not positive, or see ``bootstrap_ci``.
    """
    return bootstrap_ci(areas(errors, limit), subjects, confidence=confidence, samples=samples, seed=seed)


def failure_ci(
    errors: np.ndarray,
    limit: float = LIMIT,
    subjects: Subjects = None,
    *,
    confidence: float = 0.95,
    samples: int = SAMPLES,
    seed: int = 0,
) -> tuple[float, float]:
    """Confidence interval of ``failure_rate`` of errors (N,); see ``bootstrap_ci`` for the arguments.

    Of no failures, or nothing else, the interval is a single point: drawing again cannot show what was never seen.

    Raises:
        InputError: the errors are not a vector, the limit is not positive, or see ``bootstrap_ci``.
    """
    return bootstrap_ci(failures(errors, limit), subjects, confidence=confidence, samples=samples, seed=seed)


@dataclass(frozen=True)
class Intervals:
    """95 % bootstrap intervals of what `Summary` says, from the lower to the upper end; NaN below two subjects."""

    mean: tuple[float, float]
    median: tuple[float, float]
    auc: tuple[float, float]
    failure: tuple[float, float]

    def as_json(self, limit: float = LIMIT) -> dict[str, list[float | None]]:
        """The intervals for a JSON file; None where a number is not finite."""
        names = ("mean", "median", f"auc_{limit:g}", f"failure_{limit:g}")
        ends = (self.mean, self.median, self.auc, self.failure)
        return {name: list(map(finite_or_none, each)) for name, each in zip(names, ends, strict=True)}


def intervals(errors: np.ndarray, limit: float = LIMIT, subjects: Subjects = None) -> Intervals:
    """How sure the numbers of ``summarise(errors, limit, subjects)`` are, for errors (N,); see ``bootstrap_ci``.

    Raises:
        InputError: as `summarise`.
    """
    fitted = np.where(np.isinf(errors), np.nan, errors)
    return Intervals(
        bootstrap_ci(fitted, subjects),
        median_ci(errors, subjects),
        auc_ci(errors, limit, subjects),
        failure_ci(errors, limit, subjects),
    )


def finite_or_none(value: float) -> float | None:
    """The value for a JSON file, which has no word for infinity and NaN."""
    return value if math.isfinite(value) else None


def _paired(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both as float64.

    Raises:
        InputError: they are not vectors of one length.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise InputError(f"paired errors must both be (faces,), of the same faces; got {a.shape} and {b.shape}")
    return a, b


def _owners(subjects: Subjects, chosen: np.ndarray) -> np.ndarray:
    """(M,) numbers from 0 of the subjects of the M faces of N that are chosen (N,).

    Raises:
        InputError: there is not one subject a face.
    """
    if subjects is None:
        return np.arange(np.count_nonzero(chosen))
    if len(subjects) != len(chosen):
        raise InputError(f"expected the subject of each of {len(chosen)} faces; got {len(subjects)}")
    return np.unique(np.asarray(subjects)[chosen], return_inverse=True)[1]


def _ratio_ci95(values: np.ndarray, weights: np.ndarray, owners: np.ndarray) -> float:
    """Half-width of the 95 % interval of Σ values / Σ weights of (M,) faces; NaN below two subjects.

    Subjects are independent, not faces: it is Student's interval of the linearised ratio of their totals, and with a
    face each, and weights of one, that of the mean.
    """
    totals, shares = np.bincount(owners, values), np.bincount(owners, weights)
    count = len(totals)
    if count < 2:
        return math.nan
    rest = totals - shares * (values.sum() / weights.sum())
    deviation = math.sqrt(count / (count - 1) * np.square(rest).sum()) / weights.sum()
    return float(scipy.stats.t.ppf(0.975, count - 1) * deviation)
