"""Confidence intervals against SciPy and the bootstrap, rank tests against enumeration of all outcomes."""

import json
from itertools import combinations, product

import numpy as np
import pytest
from scipy import stats

from jaxfit.evaluation.curves import auc, failure_rate
from jaxfit.evaluation.statistics import rank_sum, signed_rank, summarise
from jaxfit.exceptions import InputError


def lognormal_errors(seed: int, faces: int) -> np.ndarray:
    return 0.05 * np.random.default_rng(seed).lognormal(sigma=0.5, size=faces)


def test_ci_is_students() -> None:
    errors = lognormal_errors(0, 12)
    summary = summarise(errors)
    low, high = stats.t.interval(0.95, df=11, loc=errors.mean(), scale=stats.sem(errors))
    assert summary.mean - summary.ci95 == pytest.approx(low)
    assert summary.mean + summary.ci95 == pytest.approx(high)


def test_ci_agrees_with_the_bootstrap() -> None:
    errors = lognormal_errors(1, 400)
    rng = np.random.default_rng(2)
    means = rng.choice(errors, (4000, errors.size)).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    assert summarise(errors).ci95 == pytest.approx((high - low) / 2, rel=0.1)


def test_failed_and_unmeasured_faces() -> None:
    errors = np.array([0.02, np.inf, 0.04, np.nan, 0.09])
    summary = summarise(errors)
    assert (summary.faces, summary.measured, summary.failed, summary.unmeasured) == (5, 3, 1, 1)
    assert summary.mean == pytest.approx(0.05)
    assert summary.median == pytest.approx(0.065)  # of 0.02, 0.04, 0.09 and inf
    assert summary.auc == auc(errors)
    assert summary.failure == failure_rate(errors) == 0.5
    assert summary.limit == 0.08


def test_json() -> None:
    written = json.loads(json.dumps(summarise(np.array([0.02, 0.04, np.inf, np.nan])).as_json(), allow_nan=False))
    assert written == {
        "faces": 4,
        "fitted": 2,
        "undetected": 1,
        "unmeasured": 1,
        "nmed": {
            "mean": pytest.approx(0.03),
            "ci95": pytest.approx(stats.t.ppf(0.975, 1) * 0.01),
            "median": pytest.approx(0.04),
        },
        "auc_0.08": pytest.approx((0.75 + 0.5) / 3),
        "failure_0.08": pytest.approx(1 / 3),
    }


def test_json_names_the_limit_and_has_none_for_what_is_not_finite() -> None:
    written = summarise(np.array([np.inf, np.inf]), limit=0.1).as_json()
    assert written["nmed"] == {"mean": None, "ci95": None, "median": None}
    assert (written["auc_0.1"], written["failure_0.1"]) == (0.0, 1.0)


@pytest.mark.parametrize("errors", [np.array([]), np.array([np.nan])], ids=["empty", "unmeasurable"])
def test_no_measurable_faces(errors: np.ndarray) -> None:
    summary = summarise(errors)
    assert (summary.faces, summary.unmeasured, summary.measured) == (errors.size, errors.size, 0)
    numbers = [summary.mean, summary.ci95, summary.median, summary.auc, summary.failure]
    assert np.isnan(numbers).all()


def test_one_face_has_no_interval() -> None:
    summary = summarise(np.array([0.05]))
    assert summary.mean == summary.median == 0.05
    assert np.isnan(summary.ci95)


def test_summary_refuses_tables() -> None:
    with pytest.raises(InputError, match=r"\(2, 2\)"):
        summarise(np.zeros((2, 2)))


def rank_sum_by_enumeration(a: np.ndarray, b: np.ndarray) -> float:
    """Share of all ways to choose a's ranks that are at least as far from the expected rank sum."""
    ranks = stats.rankdata([*a, *b])
    expected = a.size * ranks.mean()
    seen = abs(ranks[: a.size].sum() - expected)
    sums = [abs(sum(chosen) - expected) for chosen in combinations(ranks, a.size)]
    return float(np.mean(np.array(sums) >= seen - 1e-9))


def signed_rank_by_enumeration(a: np.ndarray, b: np.ndarray) -> float:
    """Share of all sign patterns with a signed-rank sum at least as far from zero."""
    ranks = stats.rankdata(np.abs(a - b))
    seen = abs(np.sum(np.sign(a - b) * ranks))
    sums = [abs(np.dot(signs, ranks)) for signs in product([-1, 1], repeat=a.size)]
    return float(np.mean(np.array(sums) >= seen - 1e-9))


@pytest.mark.parametrize("seed", range(5))
def test_rank_sum_of_small_samples(seed: int) -> None:
    a, b = lognormal_errors(seed, 5), 1.5 * lognormal_errors(seed + 10, 7)
    assert rank_sum(a, b) == pytest.approx(rank_sum_by_enumeration(a, b))


@pytest.mark.parametrize("seed", range(5))
def test_signed_rank_of_small_samples(seed: int) -> None:
    a, b = lognormal_errors(seed, 8), 1.5 * lognormal_errors(seed + 10, 8)
    assert signed_rank(a, b) == pytest.approx(signed_rank_by_enumeration(a, b))


def test_one_failure_ranks_last() -> None:
    a, b = lognormal_errors(0, 6), lognormal_errors(1, 6)
    failed, bad = a.copy(), a.copy()
    failed[2], bad[2] = np.inf, 1e6
    assert rank_sum(failed, b) == rank_sum(bad, b)
    assert signed_rank(failed, b) == signed_rank(bad, b)
    assert signed_rank(b, failed) == signed_rank(b, bad)


def test_large_samples_follow_scipys_normal_approximation() -> None:
    a, b = lognormal_errors(0, 300), 1.05 * lognormal_errors(1, 400)
    assert rank_sum(a, b) == pytest.approx(stats.ranksums(a, b).pvalue, rel=0.01)
    assert signed_rank(a, b[:300]) == pytest.approx(stats.wilcoxon(a, b[:300]).pvalue)


def test_many_failures_are_ties() -> None:
    a, b = lognormal_errors(0, 100), lognormal_errors(1, 100)
    a[:30] = b[:10] = np.inf
    worst = np.where(np.isinf(a), 1e6, a), np.where(np.isinf(b), 1e6, b)
    assert rank_sum(a, b) == stats.mannwhitneyu(*worst).pvalue < 0.05
    # Both failed on the first ten: they say nothing about which is better.
    assert signed_rank(a, b) == signed_rank(a[10:], b[10:])


def test_unmeasurable_faces_are_left_out() -> None:
    a, b = lognormal_errors(0, 9), lognormal_errors(1, 9)
    a[3] = b[5] = np.nan
    kept = np.isfinite(a) & np.isfinite(b)
    assert rank_sum(a, b) == rank_sum(np.delete(a, 3), np.delete(b, 5))
    assert signed_rank(a, b) == signed_rank(a[kept], b[kept])


@pytest.mark.parametrize("test", [rank_sum, signed_rank])
def test_rank_tests_are_symmetric_and_keep_quiet_on_no_evidence(test) -> None:
    a, b = lognormal_errors(0, 20), lognormal_errors(1, 20)
    assert test(a, b) == pytest.approx(test(b, a))
    assert test(a, a) == 1.0
    for value in (0.1, np.inf):
        assert test(np.full(4, value), np.full(4, value)) == 1.0
    assert np.isnan(test(np.array([]), np.array([])))
    assert np.isnan(test(np.array([np.nan]), np.array([np.nan])))


def test_wrong_samples() -> None:
    with pytest.raises(InputError, match="same faces"):
        signed_rank(np.zeros(3), np.zeros(4))
    with pytest.raises(InputError, match="faces"):
        rank_sum(np.zeros((3, 2)), np.zeros(4))
