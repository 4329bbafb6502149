"""Openness of eyes and mouths: what known shapes give, in every scheme that has lids and lips."""

import numpy as np
import pytest

from jaxfit.schemes.conversions import convert
from jaxfit.schemes.known import AFLW21, IBUG68, LFPW27, LFPW29, SCHEMES
from jaxfit.schemes.openness import openings_of, openness
from jaxfit.schemes.scheme import Scheme, mirrored

OPEN = [scheme for scheme in SCHEMES.values() if openings_of(scheme)]
every_scheme = pytest.mark.parametrize("scheme", OPEN, ids=lambda scheme: scheme.name)
FACES = np.random.default_rng(0).normal(0, 30, (20, 68, 2))


def test_schemes_with_lids_and_lips_say_how_far_they_are_open() -> None:
    assert OPEN == [LFPW27, LFPW29, IBUG68]
    assert openness(np.zeros((2, 21, 2)), AFLW21).shape == (2, 0)


@every_scheme
@pytest.mark.parametrize("opened", [0.0, 0.1, 0.35, 1.2])
def test_a_gap_of_so_many_widths_is_so_open(scheme: Scheme, opened: float) -> None:
    points = np.full((scheme.count, 2), np.nan)  # what does not belong to it, does not count
    for number, opening in enumerate(openings_of(scheme)):
        left, width = 100.0 * number, 10.0 * (number + 1)
        points[list(opening.corners)] = [[left, 5], [left + width, 5]]
        for place, pair in enumerate(opening.gaps):
            points[list(pair)] = [[left + place, 5], [left + place, 5 + opened * width]]
    np.testing.assert_allclose(openness(points, scheme), opened, atol=1e-12)


@every_scheme
def test_it_stays_where_faces_move_grow_and_turn_and_swaps_sides_in_the_mirror(scheme: Scheme) -> None:
    faces = FACES[:, : scheme.count]
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    before = openness(faces, scheme)
    np.testing.assert_allclose(openness(3.5 * faces @ turn + [7, -900], scheme), before, rtol=1e-9)
    np.testing.assert_allclose(openness(mirrored(faces, 640, scheme), scheme), before[:, [1, 0, 2]], rtol=1e-9)


def test_the_eye_aspect_ratio_is_that_of_its_source() -> None:
    p1, p2, p3, p4, p5, p6 = FACES[0, 36:42]  # EAR = (|p2 - p6| + |p3 - p5|) / 2 |p1 - p4|
    ratio = (np.linalg.norm(p2 - p6) + np.linalg.norm(p3 - p5)) / (2 * np.linalg.norm(p1 - p4))
    assert openness(FACES[0], IBUG68)[0] == pytest.approx(ratio)


def test_closed_eyes_are_closed_in_other_schemes_too() -> None:
    face = FACES[0].copy()
    face[[37, 38]] = face[[41, 40]]
    face[62] = face[66]
    np.testing.assert_allclose(openness(convert(face, IBUG68, LFPW27), LFPW27)[[0, 2]], 0, atol=1e-12)


def test_what_is_not_known_is_nan() -> None:
    face = FACES[0].copy()
    face[37] = np.nan  # a lid of the left eye
    face[60] = face[64]  # the mouth has no width
    assert np.isnan(openness(face, IBUG68)).tolist() == [True, False, True]
