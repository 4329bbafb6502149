"""Bilinear sampling against scipy.ndimage.map_coordinates."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy import ndimage

from jaxfit.image.sampling import bilinear, bilinear_grid, pack

HEIGHT, WIDTH = 9, 14
PICTURE = np.random.default_rng(1).uniform(0, 255, (HEIGHT, WIDTH)).astype(np.float32)


def unpacked(picture, x, y):
    return bilinear(pack(picture), x, y)


sample = jax.jit(unpacked)
sample_grid = jax.jit(bilinear_grid)
slopes = jax.jit(jax.grad(lambda picture, x, y: unpacked(picture, x, y).sum(), (0, 1, 2)))
grid_slopes = jax.jit(jax.grad(lambda picture, x, y: bilinear_grid(picture, x, y).sum(), (0, 1, 2)))


def oracle(x, y):
    return ndimage.map_coordinates(PICTURE.astype(np.float64), [y, x], order=1, mode="nearest")


def points(kind, count=126):
    rng = np.random.default_rng(2)
    last_x, last_y = WIDTH - 1, HEIGHT - 1
    x, y = {
        "inside": (rng.uniform(0, last_x, count), rng.uniform(0, last_y, count)),
        "around": (rng.uniform(-5, WIDTH + 5, count), rng.uniform(-5, HEIGHT + 5, count)),
        "pixel centres": np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)),
        "edges": (np.repeat([0, last_x], count // 2), rng.uniform(0, last_y, count)),
        "corners": np.meshgrid([0, last_x], [0, last_y]),
        "just past pixels": np.meshgrid(np.arange(WIDTH) + 1e-4, np.arange(HEIGHT) - 1e-4),
        "far away": np.meshgrid([-1e9, 1e9], [-1e9, 1e9]),
    }[kind]
    return np.resize(x, count).astype(np.float32), np.resize(y, count).astype(np.float32)


KINDS = ["inside", "around", "pixel centres", "edges", "corners", "just past pixels", "far away"]


@pytest.mark.parametrize("kind", KINDS)
def test_samples_as_scipy(kind):
    x, y = points(kind)
    np.testing.assert_allclose(sample(PICTURE, x, y), oracle(x, y), atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_the_grid_is_all_pairs(kind):
    x, y = points(kind)
    columns, rows = np.meshgrid(x, y)
    np.testing.assert_allclose(sample_grid(PICTURE, x, y), sample(PICTURE, columns, rows), atol=1e-3)


def test_the_smallest_picture():
    corners = np.array([[1, 2], [3, 4]], np.float32)
    np.testing.assert_allclose(sample(corners, np.float32([0.5, 9]), np.float32([0.5, -9])), [2.5, 2])


def test_a_point_that_is_no_number_has_no_value():
    nowhere = np.float32([np.nan, 3])
    np.testing.assert_array_equal(np.isnan(sample(PICTURE, nowhere, nowhere)), [True, False])


def test_the_gradient_is_the_slope_of_the_cell():
    x, y = points("inside")
    _, dx, dy = slopes(PICTURE, x, y)
    left, top = np.floor(x), np.floor(y)
    np.testing.assert_allclose(dx, oracle(left + 1, y) - oracle(left, y), atol=1e-2)
    np.testing.assert_allclose(dy, oracle(x, top + 1) - oracle(x, top), atol=1e-2)


@pytest.mark.parametrize("kind", ["inside", "around", "far away"])
def test_gradients_of_the_grid_are_those_of_all_pairs(kind):
    """The grid has a rule of its own for them; on the borders of cells any of two slopes would do."""
    x, y = points(kind)
    weights = np.random.default_rng(3).normal(size=(len(y), len(x))).astype(np.float32)

    def pairs(picture, x, y):
        columns, rows = jnp.meshgrid(x, y)
        return unpacked(picture, columns, rows)

    grid, expected = (
        jax.jit(jax.grad(lambda *inputs, f=f: jnp.sum(weights * f(*inputs)), (0, 1, 2)))(PICTURE, x, y)
        for f in (bilinear_grid, pairs)
    )
    for ours, theirs in zip(grid, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=2e-2)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite(kind):
    x, y = points(kind)
    assert all(np.isfinite(slope).all() for f in (slopes, grid_slopes) for slope in f(PICTURE, x, y))
