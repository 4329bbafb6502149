"""Heads posed in a few steps: what exact and noisy projections give, from afar and from near."""

from functools import partial

import cv2
import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.spatial.transform import Rotation

from jaxfit.heads.model import load_head_model
from jaxfit.schemes.known import IBUG68
from jaxfit.shapes.alignment import align_head
from jaxfit.shapes.head_pose import pose_head

HEAD = load_head_model().of(IBUG68, 0.8)
MEAN, MODES, DEVIATIONS = (np.asarray(part, np.float64) for part in (HEAD.mean, HEAD.modes, HEAD.deviations))
COUNT = 40
views = pytest.mark.parametrize("near", [False, True], ids=["far", "near"])


@partial(jax.jit, static_argnames="near")
def pose(points, weights, shapes=None, near=False):
    """Six steps, which hardly believe in noise."""
    one = partial(pose_head, HEAD, near=near, noise=1e-4, steps=6)
    if shapes is None:
        return jax.vmap(one)(points, weights)
    return jax.vmap(lambda points, weights, shape: one(points, weights, shape=shape))(points, weights, shapes)


def heads(near, seed=0):
    """Points (N, L, 2) that cameras see of random heads, with their coefficients, rotations and places, in cm."""
    rng = np.random.default_rng(seed)
    b = rng.normal(size=(COUNT, len(DEVIATIONS))) * DEVIATIONS * 0.7
    turns = Rotation.from_euler("YXZ", rng.uniform([-60, -25, -40], [60, 25, 40], (COUNT, 3)), degrees=True)
    places = rng.uniform([-15, -15, 35], [15, 15, 120], (COUNT, 3))
    solid = np.einsum("nij,nlj->nli", turns.as_matrix(), MEAN + np.tensordot(b, MODES, 1))
    depth = places[:, None, 2:] + near * solid[..., 2:]
    return ((solid[..., :2] + places[:, None, :2]) / depth).astype(np.float32), b.astype(np.float32), turns, places


def everywhere(points):
    return np.ones(points.shape[:2], np.float32)


def degrees_apart(found, turns):
    return np.degrees((Rotation.from_matrix(np.asarray(found.rotation, np.float64)).inv() * turns).magnitude())


@views
def test_exact_projections_give_pose_place_and_shape(near):
    points, b, turns, places = heads(near)
    found = pose(points, everywhere(points), near=near)
    assert found.ok.all()
    assert degrees_apart(found, turns).max() < 0.05
    assert (np.linalg.norm(found.translation - places, axis=1) / places[:, 2]).max() < 1e-3
    np.testing.assert_allclose(found.b, b, atol=0.02)


def test_near_heads_of_known_shape_lie_where_solvepnp_puts_them():
    points, b, turns, places = heads(near=True, seed=1)
    found = pose(points, everywhere(points), b, near=True)
    np.testing.assert_array_equal(found.b, b)
    for row in range(COUNT):
        solid = MEAN + np.tensordot(b[row].astype(np.float64), MODES, 1)
        ok, rvec, tvec = cv2.solvePnP(solid, points[row].astype(np.float64), np.eye(3), None)
        assert ok
        turned = Rotation.from_rotvec(rvec[:, 0]).inv() * Rotation.from_matrix(np.asarray(found.rotation[row], float))
        assert np.degrees(turned.magnitude()) < 0.01
        np.testing.assert_allclose(found.translation[row], tvec[:, 0], rtol=1e-4, atol=1e-3)
    assert degrees_apart(found, turns).max() < 0.01
    np.testing.assert_allclose(found.translation, places, rtol=1e-4, atol=1e-3)


def test_landmarks_that_do_not_count_may_be_anything_and_a_few_wild_ones_count_little():
    points, _, turns, _ = heads(near=False)
    wild, weights = points.copy(), everywhere(points)
    wild[:, :17], weights[:, :17] = np.nan, 0
    wild[:, [30, 48]] += 0.5 * np.ptp(points, 1)[:, None]
    assert degrees_apart(pose(wild, weights), turns).max() < 2


def test_from_afar_it_is_the_alternation():
    """Independent of `pose_head`: Figure 7's rounds, with the same prior."""
    points, _, turns, places = heads(near=False, seed=2)
    noisy = points + np.random.default_rng(3).normal(0, 0.1, points.shape) / places[:, None, 2:]
    found = pose(noisy.astype(np.float32), everywhere(points))
    aligned = jax.jit(jax.vmap(partial(align_head, HEAD, noise=0.01)))(jnp.asarray(noisy, jnp.float32))
    apart = degrees_apart(found, Rotation.from_matrix(np.asarray(aligned.camera.rotation, np.float64)))
    assert np.median(apart) < 0.5
    assert np.median(degrees_apart(found, turns)) < 2
    np.testing.assert_allclose(1 / np.asarray(found.translation)[:, 2], aligned.camera.scale, rtol=0.05)


@pytest.mark.parametrize(
    "points",
    [np.zeros((68, 2)), np.linspace(0, 1, 136).reshape(68, 2), np.full((68, 2), np.nan)],
    ids=["a point", "a line", "nothing"],
)
def test_points_that_say_nothing_are_not_ok(points):
    batch = np.repeat(points[None].astype(np.float32), COUNT, 0)
    assert not pose(batch, everywhere(batch)).ok.any()
