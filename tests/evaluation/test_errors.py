"""NMED: hand-computed values, invariances, and what failed and unmeasurable faces become."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfit.errors import InputError
from jaxfit.evaluation.errors import nmed
from jaxfit.schemes.known import AFLW21, IBUG68, LFPW29, SCHEMES, scheme_named
from jaxfit.schemes.normalisers import NORMALISERS, normaliser_length
from jaxfit.schemes.scheme import Scheme

FIVE = Scheme(name="five", count=5, outer_eyes=(0, 1), pupils=((0, 2), (1, 3)), ends=(0, 4))


def five_points() -> np.ndarray:
    return np.array([[[0.0, 0.0], [10.0, 0.0], [2.0, 2.0], [8.0, 2.0], [5.0, 12.0]]])


def random_faces(seed: int, faces: int = 3, scheme: Scheme = IBUG68) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 200, (faces, scheme.count, 2))


@pytest.mark.parametrize(
    ("normaliser", "length"),
    [
        *(("outer", 10.0), ("pupil", 8.0), ("box", 12.0), ("area", 120**0.5), ("diagonal", 244**0.5)),
        *(("size", 168.8**0.5), ("ends", 13.0)),
    ],
)
def test_nmed_by_hand(normaliser: str, length: float) -> None:
    truth = five_points()
    fitted = truth.copy()
    fitted[0, 0] += (3.0, 4.0)  # 5 px
    fitted[0, 4] += (0.0, -2.0)  # 2 px
    np.testing.assert_allclose(normaliser_length(truth, FIVE, normaliser), [length])
    np.testing.assert_allclose(nmed(fitted, truth, FIVE, normaliser), [7.0 / 5.0 / length])


@pytest.mark.parametrize(
    ("normaliser", "length"),
    [("outer", 15.0), ("pupil", 9.0), ("box", 20.0), ("area", 120**0.5), ("diagonal", 244**0.5), ("ends", 569**0.5)],
)
def test_nmed_in_3d_by_hand(normaliser: str, length: float) -> None:
    truth = np.array([[[0.0, 0.0, 0.0], [10.0, 10.0, 5.0], [2.0, 2.0, 0.0], [4.0, 4.0, 1.0], [5.0, 12.0, 20.0]]])
    fitted = truth.copy()
    fitted[0, 0] += (2.0, 3.0, 6.0)  # 7 px
    fitted[0, 4] += (0.0, 0.0, -2.0)  # 2 px
    np.testing.assert_allclose(normaliser_length(truth, FIVE, normaliser), [length])
    np.testing.assert_allclose(nmed(fitted, truth, FIVE, normaliser), [9.0 / 5.0 / length])


def test_without_its_depth_a_point_is_not_annotated() -> None:
    truth = np.concatenate([five_points(), np.ones((1, 5, 1))], 2)
    fitted = truth + [3.0, 0.0, 4.0]
    fitted[0, 4], truth[0, 4, 2] = 1e6, np.nan
    np.testing.assert_allclose(nmed(fitted, truth, FIVE), [0.5])
    truth[0, 0, 2] = np.nan
    assert np.isnan(nmed(fitted, truth, FIVE)).all()


def test_the_default_is_the_outer_eye_corners() -> None:
    fitted, truth = random_faces(0), random_faces(1)
    np.testing.assert_array_equal(nmed(fitted, truth, IBUG68), nmed(fitted, truth, IBUG68, "outer"))


def test_every_normaliser_has_a_title() -> None:
    assert tuple(NORMALISERS) == ("outer", "pupil", "box", "area", "diagonal", "size", "ends")
    assert all(normaliser.title for normaliser in NORMALISERS.values())


@pytest.mark.parametrize(
    ("scheme", "normaliser"),
    [(scheme, name) for scheme in SCHEMES.values() for name, each in NORMALISERS.items() if each.known_of(scheme)],
)
def test_a_perfect_fit_has_no_error(scheme: Scheme, normaliser: str) -> None:
    truth = random_faces(2, scheme=scheme)
    np.testing.assert_array_equal(nmed(truth, truth, scheme, normaliser), np.zeros(3))


@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(0.01, 100),
    angle=st.floats(-np.pi, np.pi),
    shift=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
    normaliser=st.sampled_from(["outer", "pupil", "size"]),
)
def test_nmed_is_invariant_to_similarities(
    seed: int, scale: float, angle: float, shift: tuple[float, float], normaliser: str
) -> None:
    fitted, truth = random_faces(seed), random_faces(seed + 1)
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = nmed(fitted @ turn.T + shift, truth @ turn.T + shift, IBUG68, normaliser)
    np.testing.assert_allclose(moved, nmed(fitted, truth, IBUG68, normaliser), rtol=1e-6)


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.01, 100))
def test_box_nmed_is_invariant_to_scale_and_quarter_turns(seed: int, scale: float) -> None:
    fitted, truth = random_faces(seed), random_faces(seed + 1)
    turned = nmed(scale * fitted[..., ::-1], scale * truth[..., ::-1], IBUG68, "box")
    np.testing.assert_allclose(turned, nmed(fitted, truth, IBUG68, "box"), rtol=1e-9)


def test_only_annotated_landmarks_count() -> None:
    truth = five_points()
    fitted = truth + np.array([3.0, 4.0])
    fitted[0, 4] = 1e6
    truth[0, 4] = (5.0, np.nan)
    np.testing.assert_allclose(nmed(fitted, truth, FIVE), [0.5])
    np.testing.assert_allclose(normaliser_length(truth, FIVE, "box"), [10.0])


def test_a_fit_may_lack_what_is_not_annotated() -> None:
    truth = five_points()
    truth[0, 4] = np.nan
    np.testing.assert_array_equal(nmed(truth, truth, FIVE), [0.0])


@pytest.mark.parametrize("missing", [(0, slice(None)), (0, 4), (0, 4, 1)], ids=["face", "point", "coordinate"])
def test_an_incomplete_fit_is_a_failure(missing: tuple) -> None:
    truth = np.repeat(five_points(), 2, axis=0)
    fitted = truth.copy()
    fitted[missing] = np.nan
    np.testing.assert_array_equal(nmed(fitted, truth, FIVE), [np.inf, 0.0])


def test_a_fit_that_ran_away_is_no_warning() -> None:
    truth = np.repeat(five_points(), 2, axis=0)
    fitted = truth.copy()
    fitted[0, 4], fitted[1, 4] = np.inf, 1e300
    errors = nmed(fitted, truth, FIVE)
    assert errors[0] == np.inf
    assert 1e298 < errors[1] < np.inf


@pytest.mark.parametrize(
    ("normaliser", "unknown"),
    [("outer", 1), ("pupil", 3), ("ends", 4), *((name, slice(None)) for name in ("box", "area", "diagonal", "size"))],
)
def test_without_its_normaliser_a_face_is_unmeasurable_whatever_the_fit(normaliser: str, unknown: int | slice) -> None:
    truth = np.repeat(five_points(), 2, axis=0)
    fitted = truth.copy()
    fitted[1] = np.nan
    truth[:, unknown] = np.nan
    assert np.isnan(normaliser_length(truth, FIVE, normaliser)).all()
    assert np.isnan(nmed(fitted, truth, FIVE, normaliser)).all()


@pytest.mark.parametrize("normaliser", NORMALISERS)
def test_a_vanishing_normaliser_is_unmeasurable(normaliser: str) -> None:
    truth = np.ones((1, 5, 2))
    assert np.isnan(nmed(truth + 1, truth, FIVE, normaliser)).all()


def test_lengths_keep_leading_axes() -> None:
    truth = random_faces(3, faces=6)
    for normaliser in (name for name, each in NORMALISERS.items() if each.known_of(IBUG68)):
        lengths = normaliser_length(truth.reshape(2, 3, 68, 2), IBUG68, normaliser)
        np.testing.assert_array_equal(lengths.ravel(), normaliser_length(truth, IBUG68, normaliser))
        assert normaliser_length(truth[0], IBUG68, normaliser).shape == ()


def test_no_faces_have_no_errors() -> None:
    assert nmed(np.empty((0, 21, 2)), np.empty((0, 21, 2)), AFLW21).shape == (0,)


def test_pupils_of_ibug68_are_the_centres_of_the_eye_contours() -> None:
    truth = random_faces(4)
    centres = truth[:, 36:42].mean(axis=1), truth[:, 42:48].mean(axis=1)
    expected = np.linalg.norm(centres[0] - centres[1], axis=-1)
    np.testing.assert_allclose(normaliser_length(truth, IBUG68, "pupil"), expected)


def test_a_scheme_without_eyes_is_measured_by_its_box() -> None:
    scheme = scheme_named("points7")
    truth = random_faces(5, scheme=scheme)
    with pytest.raises(InputError, match="points7 has no normaliser 'outer'; choose one that it has: box"):
        nmed(truth, truth, scheme, "outer")
    np.testing.assert_array_equal(nmed(truth, truth, scheme), nmed(truth, truth, scheme, "box"))


def test_unknown_normaliser() -> None:
    with pytest.raises(InputError, match="choose one that it has: outer, pupil, box"):
        normaliser_length(random_faces(6), IBUG68, "face")


@pytest.mark.parametrize(
    ("fitted", "truth"),
    [
        ((2, 29, 2), (3, 29, 2)),
        ((2, 21, 2), (2, 21, 2)),
        ((29, 2), (29, 2)),
        ((2, 29, 4), (2, 29, 4)),
        ((2, 29, 3), (2, 29, 2)),
        ((1, 29, 2), (2, 29, 2)),
    ],
)
def test_wrong_shapes(fitted: tuple[int, ...], truth: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"29, 2\) or .*29, 3\)"):
        nmed(np.zeros(fitted), np.zeros(truth), LFPW29)
