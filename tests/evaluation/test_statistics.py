"""Confidence intervals against SciPy and their coverage, rank tests against enumeration, Holm against statsmodels."""

import json
from itertools import combinations, product
from typing import Literal

import numpy as np
import pytest
from scipy import stats

from jaxfit.errors import InputError
from jaxfit.evaluation.curves import areas, auc, failure_rate, failures
from jaxfit.evaluation.statistics import (
    auc_ci,
    bootstrap_ci,
    failure_ci,
    holm,
    intervals,
    median_ci,
    rank_biserial,
    rank_sum,
    relative_difference,
    signed_rank,
    subject_means,
    summarise,
)


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
    both = signed_rank(a, b)
    assert both == pytest.approx(signed_rank_by_enumeration(a, b))
    assert both == pytest.approx(2 * min(signed_rank(*pair, alternative="less") for pair in ((a, b), (b, a))))


def test_less_is_less() -> None:
    a = lognormal_errors(0, 20)
    assert signed_rank(a, 1.1 * a, alternative="less") == pytest.approx(2.0**-20)
    assert signed_rank(1.1 * a, a, alternative="less") == 1.0


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


def test_rank_tests_of_textbooks() -> None:
    # Hollander and Wolfe: Hamilton depression scale factors (table 3.1) and permeability of membranes (table 4.1).
    before = np.array([1.83, 0.50, 1.62, 2.48, 1.68, 1.88, 1.55, 3.06, 1.30])
    after = np.array([0.878, 0.647, 0.598, 2.05, 1.06, 1.29, 1.06, 3.14, 1.29])
    assert signed_rank(before, after) == pytest.approx(0.0390625)  # 20 of 2^9 sign patterns
    at_term = np.array([0.80, 0.83, 1.89, 1.04, 1.45, 1.38, 1.91, 1.64, 0.73, 1.46])
    earlier = np.array([1.15, 0.88, 0.90, 0.74, 1.21])
    assert rank_sum(at_term, earlier) == pytest.approx(2 * 0.1272061, rel=1e-6)


def test_holm_by_hand() -> None:
    # Sorted 0.01, 0.02, 0.03, 0.04 times 4, 3, 2, 1 is 0.04, 0.06, 0.06, 0.04; and never less than the one before.
    np.testing.assert_allclose(holm(np.array([0.04, 0.01, 0.03, 0.02])), [0.06, 0.04, 0.06, 0.06])
    np.testing.assert_allclose(holm(np.array([0.5, 0.9])), [1.0, 1.0])
    np.testing.assert_array_equal(holm(np.array([0.3])), [0.3])
    assert holm(np.array([])).shape == (0,)


@pytest.mark.parametrize("seed", range(5))
def test_holm_is_that_of_statsmodels(seed: int) -> None:
    multipletests = pytest.importorskip("statsmodels.stats.multitest").multipletests
    p_values = np.random.default_rng(seed).beta(0.3, 3, size=13).round(3)  # some are equal
    np.testing.assert_allclose(holm(p_values), multipletests(p_values, method="holm")[1])


def test_tests_that_were_not_made_do_not_count() -> None:
    p_values = np.array([0.02, 0.001, 0.3, 0.04])
    with_gaps = np.array([np.nan, 0.02, 0.001, np.nan, 0.3, 0.04])
    adjusted = holm(with_gaps)
    np.testing.assert_array_equal(np.isnan(adjusted), np.isnan(with_gaps))
    np.testing.assert_array_equal(adjusted[~np.isnan(adjusted)], holm(p_values))
    assert np.isnan(holm(np.full(2, np.nan))).all()


@pytest.mark.parametrize("wrong", [[0.1, 1.1], [-0.1], [[0.1]], [np.inf]])
def test_holm_refuses_what_is_no_p_value(wrong: list) -> None:
    with pytest.raises(InputError, match="p-values"):
        holm(np.array(wrong))


def clustered_errors(seed: int, subjects: int, faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors of people with easy and difficult faces, and who they are of."""
    rng = np.random.default_rng(seed)
    difficulty = rng.lognormal(sigma=0.5, size=subjects)
    owners = np.repeat(np.arange(subjects), faces)
    return 0.05 * difficulty[owners] * rng.lognormal(sigma=0.3, size=owners.size), owners


def test_bootstrap_is_scipys() -> None:
    values = lognormal_errors(3, 60)
    expected = stats.bootstrap(
        (values,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    width = expected.high - expected.low
    np.testing.assert_allclose(bootstrap_ci(values, samples=20_000), expected, atol=0.03 * width)
    ninety = stats.norm.ppf(0.95) / stats.norm.ppf(0.975)
    low, high = bootstrap_ci(values, samples=20_000, confidence=0.9)
    assert high - low == pytest.approx(ninety * width, rel=0.05)


def test_bootstrap_of_subjects_is_scipys_of_their_totals() -> None:
    values, owners = clustered_errors(4, 30, 5)
    values, owners = values[7:], owners[7:]  # one has no faces left, one has three
    totals, faces = np.bincount(owners, values)[1:], np.bincount(owners)[1:]
    expected = stats.bootstrap(
        (totals, faces),
        lambda totals, faces, axis: totals.sum(axis) / faces.sum(axis),
        paired=True,
        n_resamples=20_000,
        method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval
    names = [f"person {owner}" for owner in owners]
    width = expected.high - expected.low
    np.testing.assert_allclose(bootstrap_ci(values, names, samples=20_000), expected, atol=0.03 * width)


def test_intervals_are_of_contributions() -> None:
    errors, owners = clustered_errors(5, 20, 4)
    errors[3], errors[8] = np.inf, np.nan
    for interval, measure, each in ((auc_ci, auc, areas), (failure_ci, failure_rate, failures)):
        low, high = interval(errors, 0.06, owners)
        assert low < measure(errors, 0.06) < high
        assert (low, high) == bootstrap_ci(each(errors, 0.06), owners)
        assert interval(errors, 0.06, owners, seed=1) != (low, high) == interval(errors, 0.06, owners, seed=0)


def test_intervals_of_subjects_cover_the_truth_and_those_of_faces_do_not() -> None:
    truth = auc(clustered_errors(100, 100_000, 10)[0])
    covered = np.zeros(2)
    for seed in range(200):
        errors, owners = clustered_errors(seed, 40, 10)
        for column, subjects in enumerate((owners, None)):
            low, high = auc_ci(errors, subjects=subjects, samples=400)
            covered[column] += low <= truth <= high
    of_subjects, of_faces = covered / 200
    assert 0.9 <= of_subjects <= 0.98
    assert of_faces < 0.75


def test_intervals_of_medians_are_scipys() -> None:
    values = lognormal_errors(6, 61)
    for count in (60, 61):  # with two middle faces, and with one
        expected = stats.bootstrap((values[:count],), np.median, n_resamples=500, method="percentile", rng=0)
        assert median_ci(values[:count], samples=500) == pytest.approx(expected.confidence_interval)


def test_intervals_of_medians_draw_people_with_all_their_faces() -> None:
    errors, owners = clustered_errors(7, 12, 5)
    errors[:3] = np.inf
    rng = np.random.default_rng(0)
    drawn = rng.integers(12, size=(300, 12))
    medians = [np.median(np.concatenate([errors[owners == owner] for owner in people])) for people in drawn]
    assert median_ci(np.append(errors, np.nan), np.append(owners, 3), samples=300) == pytest.approx(
        np.quantile(medians, [0.025, 0.975])
    )


def test_intervals_of_medians_cover_the_truth() -> None:
    truth = np.median(clustered_errors(100, 100_000, 10)[0])
    covered = 0
    for seed in range(200):
        low, high = median_ci(*clustered_errors(seed, 40, 10), samples=300)
        covered += low <= truth <= high
    assert 0.9 <= covered / 200 <= 0.98


def test_most_failures_make_infinite_medians() -> None:
    assert median_ci(np.array([0.1, 0.2, *[np.inf] * 40])) == (np.inf, np.inf)
    low, high = median_ci(np.array([*[0.1] * 10, *[np.inf] * 10]))
    assert (low, high) == (0.1, np.inf)


def test_all_intervals_hold_what_the_summary_says() -> None:
    errors, owners = clustered_errors(8, 20, 4)
    errors[:2] = np.inf
    found, summary = intervals(errors, subjects=owners), summarise(errors, subjects=owners)
    for name in ("mean", "median", "auc", "failure"):
        low, high = getattr(found, name)
        assert low < getattr(summary, name) < high
    assert list(found.as_json()) == ["mean", "median", "auc_0.08", "failure_0.08"]
    assert found.as_json()["mean"] == list(found.mean)


@pytest.mark.parametrize("alternative", ["two-sided", "less"])
@pytest.mark.parametrize("count", [4, 7])
def test_ties_of_few_pairs_are_tested_as_by_scipy(count: int, alternative: Literal["two-sided", "less"]) -> None:
    rng = np.random.default_rng(count)
    a = rng.integers(0, 9, count).astype(float)
    b = a + rng.choice([-2, -1, 1, 1, 2], count)
    expected = stats.wilcoxon(a - b, alternative=alternative).pvalue
    assert signed_rank(a, b, alternative=alternative) == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(5))
def test_effect_sizes_belong_to_the_signed_rank_test(seed: int) -> None:
    a, b = lognormal_errors(seed, 20), lognormal_errors(seed + 50, 20)
    # SciPy's statistic is the smaller of the sums of ranks of either sign.
    smaller, whole = stats.wilcoxon(a, b).statistic, 20 * 21 / 2
    assert abs(rank_biserial(a, b)) == pytest.approx(1 - 2 * smaller / whole)
    assert rank_biserial(a, b) == -rank_biserial(b, a)
    failed = a.copy()
    failed[:3] = np.inf
    assert rank_biserial(failed, a) == 1


def test_effect_sizes_without_a_difference() -> None:
    errors = lognormal_errors(0, 9)
    assert rank_biserial(errors, errors) == 0
    assert np.isnan(rank_biserial(errors, np.full(9, np.nan)))
    # People, not faces: the mean of a's first person is larger, the second person's are the same.
    a, b = np.array([0.1, 0.5, 0.2]), np.array([0.2, 0.3, 0.2])
    assert rank_biserial(a, b, ["x", "x", "y"]) == 1


def test_intervals_of_means_are_those_of_clusters() -> None:
    api = pytest.importorskip("statsmodels.api")
    errors, owners = clustered_errors(9, 8, 6)
    errors, owners = errors[4:], owners[4:]  # of different sizes
    known = np.append(errors, [np.inf, np.nan])
    summary = summarise(known, subjects=np.append(owners, [0, 1]))
    clustered = {"groups": owners, "use_correction": True, "df_correction": True}
    model = api.OLS(errors, np.ones(errors.size)).fit(cov_type="cluster", cov_kwds=clustered, use_t=True)
    ((low, high),) = model.conf_int()
    assert (summary.mean - summary.ci95, summary.mean + summary.ci95) == pytest.approx((low, high))
    with pytest.raises(InputError, match="subject of each of 44 faces; got 2"):
        summarise(errors, subjects=["a", "b"])


def two_methods(seed: int, subjects: int = 7, faces: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of two methods that are equally good, though not with everyone, and who they are of."""
    errors, owners = clustered_errors(seed, subjects, faces)
    rng = np.random.default_rng([seed, 1])
    other = errors * rng.lognormal(sigma=0.1, size=subjects)[owners] * rng.lognormal(sigma=0.1, size=owners.size)
    return errors * rng.lognormal(sigma=0.1, size=subjects)[owners], other, owners


def test_with_few_people_means_and_differences_are_covered_and_tests_keep_quiet() -> None:
    runs = 300
    truth = clustered_errors(100, 100_000, 10)[0].mean()
    covered, found = np.zeros(2), np.zeros(2)
    for seed in range(runs):
        errors, other, owners = two_methods(seed)
        difference, width = relative_difference(errors, other, owners)
        covered[0] += abs(difference) <= width
        summary = summarise(clustered_errors(seed, 20, 10)[0], subjects=np.repeat(np.arange(20), 10))
        covered[1] += abs(summary.mean - truth) <= summary.ci95
        found += [signed_rank(errors, other, owners) < 0.05, signed_rank(errors, other) < 0.05]
    assert (covered / runs >= 0.9).all()
    assert found[0] / runs < 0.08
    assert found[1] / runs > 0.4


def test_relative_differences() -> None:
    errors, other, owners = two_methods(1)
    assert relative_difference(1.1 * errors, errors, owners) == pytest.approx((0.1, 0.0))
    difference, width = relative_difference(errors, other, owners)
    totals = np.bincount(owners, errors), np.bincount(owners, other)
    assert difference == pytest.approx(totals[0].sum() / totals[1].sum() - 1)
    # The jackknife over people, an independent way to the same.
    left_out = (totals[0].sum() - totals[0]) / (totals[1].sum() - totals[1])
    deviation = np.sqrt(6 / 7 * np.square(left_out - left_out.mean()).sum())
    assert width == pytest.approx(stats.t.ppf(0.975, 6) * deviation, rel=0.1)
    # What one of the two failed on, or could not measure, is left out.
    gaps = np.append(errors, [np.inf, np.nan, 0.1]), np.append(other, [0.1, 0.1, np.inf])
    assert relative_difference(*gaps, np.append(owners, [0, 0, 0])) == (difference, width)
    assert np.isnan(relative_difference(np.ones(3), np.zeros(3))).all()
    assert np.isnan(relative_difference(np.array([0.1]), np.array([0.2]))[1])


def test_people_are_paired_by_their_means() -> None:
    errors, other, owners = two_methods(2)
    means = [np.array([of[owners == person].mean() for person in range(7)]) for of in (errors, other)]
    np.testing.assert_allclose(subject_means(errors, owners), means[0])
    assert signed_rank(errors, other, owners) == signed_rank(*means)
    # A face that both failed on does not take its person along; one that a single method failed on does.
    a, b = np.append(errors, [np.inf, np.nan]), np.append(other, [np.inf, 0.1])
    people = np.append(owners, [0, 1])
    assert signed_rank(a, b, people) == signed_rank(*means)
    a[-2], means[1][0] = 0.1, 1e9
    assert signed_rank(a, b, people) == signed_rank(*means)
    assert signed_rank(np.array([np.inf]), np.array([np.inf]), ["a"]) == 1.0
    with pytest.raises(InputError, match="subject of each of 2 faces; got 1"):
        signed_rank(np.zeros(2), np.ones(2), ["a"])


def test_one_subject_a_face_is_no_subjects() -> None:
    values = lognormal_errors(6, 30)
    assert bootstrap_ci(values, np.arange(30)) == bootstrap_ci(values)


def test_memory_decides_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    values, owners = clustered_errors(7, 50, 2)
    whole = bootstrap_ci(values, owners)
    monkeypatch.setattr("jaxfit.evaluation.statistics._DRAWS", 700)
    assert bootstrap_ci(values, owners) == whole


def test_faces_without_values_are_left_out() -> None:
    values, owners = clustered_errors(8, 12, 3)
    gaps = values.copy()
    gaps[[0, 1, 2, 10]] = np.nan  # all of one subject, and one of another
    kept = ~np.isnan(gaps)
    assert bootstrap_ci(gaps, owners) == bootstrap_ci(values[kept], owners[kept])
    assert bootstrap_ci(gaps) == bootstrap_ci(values[kept])


@pytest.mark.parametrize("values", [[], [np.nan, np.nan], [0.1], [0.1, np.nan]])
def test_too_few_values_have_no_interval(values: list[float]) -> None:
    assert np.isnan(bootstrap_ci(np.array(values))).all()
    assert np.isnan(auc_ci(np.array(values))).all()


def test_one_subject_has_no_interval() -> None:
    assert np.isnan(bootstrap_ci(np.array([0.1, 0.2, 0.3]), ["Anna", "Anna", "Anna"])).all()
    assert np.isnan(bootstrap_ci(np.array([0.1, 0.2, np.nan]), ["Anna", "Anna", "Ben"])).all()
    assert np.isfinite(bootstrap_ci(np.array([0.1, 0.2, 0.3]), ["Anna", "Anna", "Ben"])).all()


def test_no_failures_are_a_point() -> None:
    assert failure_ci(np.full(10, 0.01)) == (0.0, 0.0)
    assert failure_ci(np.full(10, np.inf)) == (1.0, 1.0)
    assert auc_ci(np.full(10, np.inf)) == (0.0, 0.0)


def test_bootstrap_refuses_wrong_arguments() -> None:
    values = np.array([0.1, 0.2])
    with pytest.raises(InputError, match="1 infinite"):
        bootstrap_ci(np.array([0.1, np.inf]))
    with pytest.raises(InputError, match=r"\(2, 2\)"):
        bootstrap_ci(np.zeros((2, 2)))
    with pytest.raises(InputError, match="subject of each of 2 faces; got 3"):
        bootstrap_ci(values, ["a", "b", "c"])
    for wrong in ({"confidence": 1.0}, {"samples": 0}, {"seed": -1}):
        with pytest.raises(InputError, match="0 < confidence < 1"):
            bootstrap_ci(values, **wrong)
