"""CED, AUC and failure rate against counting and numerical integration."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfit.errors import InputError
from jaxfit.evaluation.curves import areas, auc, ced, failure_rate, failures, measurable

ERRORS = st.lists(st.floats(0, 0.5) | st.sampled_from([np.inf, np.nan]), max_size=30).map(np.array)


def test_ced_by_hand() -> None:
    errors = np.array([0.04, np.nan, 0.02, np.inf, 0.04])
    np.testing.assert_array_equal(ced(errors, np.array([0.04, 0.0, 0.03, 1.0])), [0.75, 0.0, 0.25, 0.75])


@given(ERRORS)
def test_ced_is_the_share_of_measurable_faces(errors: np.ndarray) -> None:
    thresholds = np.linspace(0, 0.5, 7)
    known = [error for error in errors if not np.isnan(error)]
    expected = [sum(e <= t for e in known) / len(known) if known else np.nan for t in thresholds]
    np.testing.assert_allclose(ced(errors, thresholds), expected)


@given(ERRORS, st.floats(0.01, 0.5))
def test_auc_is_the_integral_of_the_ced(errors: np.ndarray, limit: float) -> None:
    cells = 20_000
    middles = (np.arange(cells) + 0.5) * limit / cells
    np.testing.assert_allclose(auc(errors, limit), ced(errors, middles).mean(), atol=1 / cells)


@given(ERRORS, st.floats(0.01, 0.5))
def test_failures_are_what_the_ced_has_not_reached(errors: np.ndarray, limit: float) -> None:
    np.testing.assert_allclose(failure_rate(errors, limit), 1 - ced(errors, np.array([limit]))[0])


def test_extremes() -> None:
    assert auc(np.zeros(4)) == 1.0
    assert failure_rate(np.zeros(4)) == 0.0
    assert auc(np.full(4, np.inf)) == 0.0
    assert failure_rate(np.full(4, np.inf)) == 1.0


def test_an_undetected_face_fails_and_an_unmeasurable_one_is_left_out() -> None:
    assert failure_rate(np.array([0.01, np.inf])) == 0.5
    assert failure_rate(np.array([0.01, np.nan])) == 0.0
    assert auc(np.array([0.04, np.inf])) == pytest.approx(0.25)
    assert auc(np.array([0.04, np.nan])) == pytest.approx(0.5)


def test_what_each_face_contributes() -> None:
    errors = np.array([0.0, np.nan, 0.02, 0.08, 0.1, np.inf])
    np.testing.assert_allclose(areas(errors), [1.0, np.nan, 0.75, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(failures(errors), [0.0, np.nan, 0.0, 0.0, 1.0, 1.0])


@given(ERRORS, st.floats(0.01, 0.5))
def test_measures_are_means_of_contributions(errors: np.ndarray, limit: float) -> None:
    known = ~np.isnan(errors)
    for each, measure in ((areas, auc), (failures, failure_rate)):
        contributions = each(errors, limit)
        np.testing.assert_array_equal(np.isnan(contributions), ~known)
        if known.any():
            assert measure(errors, limit) == pytest.approx(sum(contributions[known]) / known.sum())


def test_an_error_at_the_limit_is_no_failure() -> None:
    assert failure_rate(np.array([0.08])) == 0.0


@pytest.mark.parametrize("errors", [np.array([]), np.array([np.nan])], ids=["empty", "unmeasurable"])
def test_no_measurable_faces(errors: np.ndarray) -> None:
    assert np.isnan(auc(errors))
    assert np.isnan(failure_rate(errors))
    assert np.isnan(ced(errors, np.array([0.1, 0.2]))).all()


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, np.inf])
def test_limit_must_be_positive(limit: float) -> None:
    for measure in (auc, failure_rate, areas, failures):
        with pytest.raises(InputError, match="limit must be a positive number"):
            measure(np.array([0.1]), limit)


def test_errors_must_be_a_vector() -> None:
    for measure in (measurable, auc, failure_rate, areas, failures):
        with pytest.raises(InputError, match=r"\(2, 3\)"):
            measure(np.zeros((2, 3)))
