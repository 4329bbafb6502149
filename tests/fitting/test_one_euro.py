"""The One-Euro filter against what it promises: rest, steps, noise, and the lag that theory says."""

import numpy as np
import pytest

from jaxfit.errors import InputError
from jaxfit.fitting.one_euro import OneEuro

RATE = 30.0


def smoothed(how: OneEuro, points: np.ndarray, size: float = 1.0, rate: float = RATE) -> np.ndarray:
    """Points (T, N, 2) through the filter, evenly spaced in time."""
    state = how.start(points[0], 0.0)
    out = [state.points]
    for number, measured in enumerate(points[1:], 1):
        state = how.follow(state, measured, number / rate, size)
        out.append(state.points)
    return np.array(out)


def test_a_constant_stays() -> None:
    points = np.tile(np.array([[3.0, -4.0], [100.0, 7.0]]), (20, 1, 1))
    np.testing.assert_array_equal(smoothed(OneEuro(), points), points)


def test_a_step_arrives() -> None:
    points = np.zeros((90, 1, 2))
    points[10:] = 1.0
    out = smoothed(OneEuro(), points)
    assert 0 < out[10, 0, 0] < 1
    assert (np.diff(out[:, 0, 0]) >= 0).all()
    assert out[-1, 0, 0] == pytest.approx(1, abs=1e-3)


def test_a_noisy_constant_varies_less_as_the_cutoff_says() -> None:
    noise = np.random.default_rng(0).normal(0, 1e-3, (4000, 3, 2))
    out = smoothed(OneEuro(cutoff=1.0, gain=0.0), noise)[100:]
    turned = 2 * np.pi / RATE
    share = turned / (turned + 1)
    assert out.var() == pytest.approx(noise.var() * share / (2 - share), rel=0.05)
    assert smoothed(OneEuro(), noise)[100:].var() < noise.var() / 3


@pytest.mark.parametrize(("speed", "rate"), [(0.5, 30.0), (2.0, 30.0), (2.0, 100.0)])
def test_a_ramp_lags_as_theory_says(speed: float, rate: float) -> None:
    how = OneEuro(cutoff=1.5, gain=3.0)
    direction = np.array([0.6, 0.8])
    ramp = speed * np.arange(int(5 * rate))[:, None, None] / rate * direction
    lag = (ramp - smoothed(how, ramp, rate=rate))[-1, 0] @ direction / speed
    assert lag == pytest.approx(1 / (2 * np.pi * (1.5 + 3.0 * speed)), rel=1e-6)


def test_scaling_the_picture_scales_what_comes_out() -> None:
    points = np.random.default_rng(1).normal(0, 0.1, (50, 4, 2)).cumsum(0)
    np.testing.assert_allclose(smoothed(OneEuro(), 7 * points, 7.0), 7 * smoothed(OneEuro(), points), rtol=1e-12)


def test_turning_the_picture_turns_what_comes_out() -> None:
    points = np.random.default_rng(2).normal(0, 0.1, (50, 4, 2)).cumsum(0)
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    np.testing.assert_allclose(smoothed(OneEuro(), points @ turn), smoothed(OneEuro(), points) @ turn, atol=1e-12)


def test_uneven_times_follow_the_clock() -> None:
    """A frame that was dropped weighs less than it would if no time had passed."""
    how = OneEuro(gain=0.0)
    start = how.start(np.zeros((1, 2)), 0.0)
    soon, late = (how.follow(start, np.ones((1, 2)), seconds, 1.0).points for seconds in (1 / 30, 1 / 3))
    assert (soon < late).all()


def test_bad_input() -> None:
    for wrong in ({"cutoff": 0.0}, {"gain": -1.0}, {"velocity_cutoff": float("nan")}):
        with pytest.raises(InputError, match="positive cutoffs"):
            OneEuro(**wrong)
    how = OneEuro()
    with pytest.raises(InputError, match="a time after"):
        how.follow(how.start(np.zeros((1, 2)), 1.0), np.zeros((1, 2)), 1.0, 1.0)
