"""Similarity alignment against general least squares and scipy's orthogonal Procrustes."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.linalg import orthogonal_procrustes

from jaxfit.shapes.points import PointSpace
from jaxfit.shapes.procrustes import align_similarity
from jaxfit.shapes.space import Start

MEAN = np.random.default_rng(0).normal(0, 10, (7, 2))
MEAN -= MEAN.mean(0)
align = jax.jit(lambda points: align_similarity(points, jnp.asarray(MEAN, jnp.float32)))


def least_squares(points):
    """Centre, scale and rotation by linear least squares: x' = a x − b y + c, y' = b x + a y + d."""
    (x, y), one, zero = MEAN.T, np.ones(len(MEAN)), np.zeros(len(MEAN))
    matrix = np.concatenate([np.stack([x, -y, one, zero], 1), np.stack([y, x, zero, one], 1)])
    a, b, c, d = np.linalg.lstsq(matrix, points.T.reshape(-1), rcond=None)[0]
    return [c, d], np.hypot(a, b), np.arctan2(b, a)


@pytest.mark.parametrize("seed", range(5))
def test_is_the_least_squares_similarity(seed):
    # Unrelated points and mirror images too, where Procrustes without a condition would reflect.
    points = np.random.default_rng(seed).normal(50, 12, MEAN.shape) if seed else MEAN * [-1, 1] + 50
    found = align(points.astype(np.float32))
    for value, expected in zip(found, least_squares(points), strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-3)


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_agrees_with_scipys_procrustes(noise):
    turn = np.array([[np.cos(0.7), np.sin(0.7)], [-np.sin(0.7), np.cos(0.7)]])
    points = 1.7 * MEAN @ turn + [30, 60] + noise * np.random.default_rng(1).normal(size=MEAN.shape)
    rotation, singular_values = orthogonal_procrustes(MEAN, points - points.mean(0))
    found = align(points.astype(np.float32))
    np.testing.assert_allclose(found.centre, points.mean(0), atol=1e-3)
    np.testing.assert_allclose(found.scale, singular_values / (MEAN**2).sum(), atol=1e-4)
    np.testing.assert_allclose(found.rotation, np.arctan2(rotation[0, 1], rotation[0, 0]), atol=1e-4)


@pytest.mark.parametrize("rotation", [0.0, 1.2, -3.0, 3.1])
@pytest.mark.parametrize("scale", [0.1, 4.0])
def test_undoes_placing(scale, rotation):
    space = PointSpace(jnp.asarray(MEAN, jnp.float32))
    start = Start(jnp.array([-5.0, 70.0]), jnp.float32(scale), jnp.float32(rotation))
    for found, expected in zip(align(space.landmarks(space.place(start))), start, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)
