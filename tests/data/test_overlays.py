"""Drawings change what they should and nothing else."""

import numpy as np
import pytest

from jaxfit.data.overlays import draw_landmarks
from jaxfit.exceptions import InputError
from jaxfit.shapes.schemes import AFLW21, IBUG68, Scheme

POINT = Scheme(name="points1", count=1)
CYAN, RED = [0, 255, 255], [255, 60, 60]


def ring(count, centre, radius):
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return centre + radius * np.stack([np.cos(angles), np.sin(angles)], 1)


def test_the_picture_itself_stays_and_grey_becomes_rgb():
    grey = np.full((50, 60), 9, np.uint8)
    drawn = draw_landmarks(grey, ring(68, [30, 25], 20), IBUG68)
    assert drawn.shape == (50, 60, 3)
    assert (grey == 9).all()
    rgb = np.dstack([grey] * 3)
    np.testing.assert_array_equal(draw_landmarks(rgb, ring(68, [30, 25], 20), IBUG68), drawn)
    assert (rgb == 9).all()


def test_points_lie_where_they_belong_to_a_fraction_of_a_pixel():
    drawn = draw_landmarks(np.zeros((40, 40), np.uint8), np.array([[20.5, 11.25]]), POINT)
    weights = drawn[..., 1] / drawn[..., 1].sum()
    y, x = np.mgrid[:40, :40]
    np.testing.assert_allclose([(weights * x).sum(), (weights * y).sum()], [20.5, 11.25], atol=0.2)


def test_colours_and_what_lies_on_top():
    black = np.zeros((40, 40), np.uint8)
    here, there = np.array([[10.0, 10.0]]), np.array([[30.0, 30.0]])
    drawn = draw_landmarks(black, here, POINT, truth=there)
    assert drawn[10, 10].tolist() == CYAN
    assert drawn[30, 30].tolist() == RED
    assert draw_landmarks(black, here, POINT, truth=here)[10, 10].tolist() == CYAN
    boxed = draw_landmarks(black, here, POINT, box=np.array([5.0, 6.0, 20.0, 30.0]))
    assert all(boxed[y, x].any() for x, y in ((5, 6), (25, 6), (5, 36), (25, 36), (15, 6)))
    assert not boxed[20, 15].any()


@pytest.mark.parametrize("size", [60, 600, 3000])
def test_faces_are_drawn_as_boldly_whatever_the_resolution(size):
    drawn = draw_landmarks(np.zeros((size, size), np.uint8), ring(68, size / 2, size / 3), IBUG68)
    assert 0.01 < (drawn.max(2) > 100).mean() < 0.2


def test_unknown_and_distant_points_are_survived():
    points = ring(21, [25, 25], 20)
    points[4:18] = np.nan
    points[19] = [1e300, -1e300]
    drawn = draw_landmarks(np.zeros((50, 50), np.uint8), points, AFLW21)
    assert drawn.any()
    nothing = draw_landmarks(np.zeros((50, 50), np.uint8), np.full((21, 2), np.nan), AFLW21, box=np.full(4, np.nan))
    assert not nothing.any()


def test_landmarks_must_fit_the_scheme():
    with pytest.raises(InputError, match=r"\(68, 2\).*ibug68.*\(21, 2\)"):
        draw_landmarks(np.zeros((50, 50), np.uint8), np.zeros((21, 2)), IBUG68)
