"""AUROC and calibration error against brute force, and what they say of forecasters whose quality is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfit.errors import InputError
from jaxfit.evaluation.calibration import auroc, calibration_error, reliability

# Few different values, so that there are ties, some at the edges of bins.
forecasts = st.lists(st.tuples(st.integers(0, 30).map(lambda n: n / 30), st.booleans()), min_size=1, max_size=40)


@given(forecasts)
def test_auroc_counts_pairs(pairs: list[tuple[float, bool]]) -> None:
    wins = [(a > b) + (a == b) / 2 for a, hit in pairs if hit for b, other in pairs if not other]
    found = auroc(*map(np.array, zip(*pairs, strict=True)))
    assert math.isnan(found) if not wins else found == pytest.approx(sum(wins) / len(wins))


@given(forecasts, st.integers(1, 20))
def test_calibration_error_is_that_of_a_loop_over_bins(pairs: list[tuple[float, bool]], bins: int) -> None:
    told, happened = map(np.array, zip(*pairs, strict=True))
    error = 0.0
    for k in range(bins):
        within = np.ceil(told * bins) == k + 1
        if k == 0:
            within |= told == 0
        if within.any():
            error += within.mean() * abs(told[within].mean() - happened[within].mean())
    assert calibration_error(told, happened, bins) == pytest.approx(error)
    assert reliability(told, happened, bins).counts.sum() == len(pairs)


def test_honest_and_boastful_forecasters() -> None:
    rng = np.random.default_rng(0)
    chance = rng.random(40_000)
    happened = rng.random(40_000) < chance
    assert calibration_error(chance, happened) < 0.01
    assert calibration_error((chance > 0.5).astype(float), happened) == pytest.approx(0.25, abs=0.01)
    assert auroc(chance, happened) == pytest.approx(5 / 6, abs=0.01)  # of chances that are evenly distributed
    assert auroc(-chance, happened) == pytest.approx(1 / 6, abs=0.01)


def test_nothing_is_told_of_nothing() -> None:
    assert math.isnan(calibration_error(np.empty(0), np.empty(0, bool)))
    assert math.isnan(auroc(np.ones(3), np.ones(3, bool)))


@pytest.mark.parametrize(
    ("told", "happened"), [([0.5, 0.5], [True]), ([np.nan], [True]), ([1.1], [True]), ([[0.5]], [[True]])]
)
def test_what_are_no_probabilities_is_refused(told, happened) -> None:
    with pytest.raises(InputError, match="expected"):
        calibration_error(np.array(told), np.array(happened))
