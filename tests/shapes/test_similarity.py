"""The parametric shape space: Eq. 11 written out, encoding against scipy's least squares, and what stretches do."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.optimize import least_squares

from jaxfit.shapes.procrustes import generalised_procrustes
from jaxfit.shapes.similarity import learn_similarity_asm, unstretched

COUNT, POINTS = 50, 9


def learned(sigmas=3.0, share=0.9):
    rng = np.random.default_rng(0)
    faces = rng.normal(0, 30, (POINTS, 2)) + rng.normal(0, 4, (COUNT, POINTS, 2))
    return learn_similarity_asm(jnp.asarray(faces, jnp.float32), 100.0, share, sigmas)


SPACE = learned()
MODES = SPACE.size - 5
encode = jax.jit(SPACE.encode)
landmarks_of = jax.jit(SPACE.landmarks)
difference = jax.jit(SPACE.difference)
advance = jax.jit(SPACE.advance)


def random_params(seed, radius=2.0, stretch=0.2):
    rng = np.random.default_rng(seed)
    b = rng.normal(size=MODES)
    b *= radius / np.linalg.norm(b) * np.asarray(SPACE.model.deviations)
    scales = np.exp(rng.normal(0, 0.4) + stretch * rng.normal(size=2))
    return jnp.asarray([*b, *scales, *rng.normal(100, 50, 2), rng.uniform(-np.pi, np.pi)], jnp.float32)


def eq_11(params):
    """L = R · (B₀ + Σ bᵢ Bᵢ) + T, on column vectors."""
    *b, s_x, s_y, d_x, d_y, theta = np.asarray(params, np.float64)
    shape = np.asarray(SPACE.model.mean) + sum(
        w * np.asarray(mode) for w, mode in zip(b, SPACE.model.modes, strict=True)
    )
    c, s = np.cos(theta), np.sin(theta)
    return (np.array([[s_x * c, -s_x * s], [s_y * s, s_y * c]]) @ shape.T + [[d_x], [d_y]]).T


@pytest.mark.parametrize("seed", range(5))
def test_landmarks_are_equation_11(seed):
    np.testing.assert_allclose(landmarks_of(random_params(seed)), eq_11(random_params(seed)), atol=1e-3)


def test_the_scale_is_the_mean_of_both():
    assert SPACE.scale(random_params(0)) == pytest.approx(np.mean(random_params(0)[-5:-3]))


@pytest.mark.parametrize("seed", range(20))
def test_encoding_undoes_landmarks(seed):
    params = random_params(seed, radius=2.9)
    units = np.r_[SPACE.model.deviations, 1, 1, 100, 100, 1]
    np.testing.assert_allclose((encode(landmarks_of(params)) - params) / units, 0, atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_encoding_is_least_squares(seed):
    rng = np.random.default_rng(seed)
    landmarks = eq_11(random_params(seed, radius=1.0)) + rng.normal(0, 1.0, (POINTS, 2))
    found = encode(jnp.asarray(landmarks, jnp.float32))
    solved = least_squares(lambda params: (eq_11(params) - landmarks).ravel(), np.asarray(found, np.float64))
    assert np.linalg.norm(np.asarray(found)[:MODES] / SPACE.model.deviations) < 3, "this seed tests the ellipsoid"
    np.testing.assert_allclose(landmarks_of(found), eq_11(solved.x), atol=0.02)


def test_encoding_stays_in_the_ellipsoid_with_the_best_pose_for_it():
    landmarks = eq_11(random_params(3, radius=6.0))
    found = np.asarray(encode(jnp.asarray(landmarks, jnp.float32)), np.float64)
    assert np.linalg.norm(found[:MODES] / SPACE.model.deviations) == pytest.approx(3, abs=1e-4)
    pose = least_squares(lambda pose: (eq_11([*found[:MODES], *pose]) - landmarks).ravel(), found[MODES:]).x
    np.testing.assert_allclose(landmarks_of(jnp.float32(found)), eq_11([*found[:MODES], *pose]), atol=0.02)


def test_steps_end_in_the_ellipsoid():
    far = jnp.zeros(SPACE.size).at[:MODES].set(10 * SPACE.model.deviations)
    moved = advance(random_params(0), far)
    assert np.linalg.norm(moved[:MODES] / SPACE.model.deviations) == pytest.approx(3, abs=1e-4)


@pytest.mark.parametrize(
    ("here", "there", "way"), [(3.0, -3.0, 2 * np.pi - 6), (-3.0, 3.0, 6 - 2 * np.pi), (0.5, 1.0, 0.5)]
)
def test_rotations_go_the_shorter_way_round(here, there, way):
    first, last = (random_params(0).at[-1].set(angle) for angle in (here, there))
    step = difference(last, first)
    assert step[-1] == pytest.approx(way, abs=1e-5)
    assert advance(first, step)[-1] == pytest.approx(there, abs=1e-5)


def test_modes_do_not_stretch_or_move():
    # At the mean, what b does is orthogonal to what scales and place do.
    mean = jnp.zeros(SPACE.size).at[-5:-3].set(1.0)
    slopes = np.asarray(jax.jit(jax.jacfwd(SPACE.landmarks))(mean)).reshape(-1, SPACE.size)
    slopes = slopes / np.linalg.norm(slopes, axis=0)
    np.testing.assert_allclose(slopes[:, :MODES].T @ slopes[:, MODES:-1], 0, atol=1e-4)


def test_the_stretch_is_removed_exactly():
    faces = np.random.default_rng(1).normal(size=(COUNT, POINTS, 2))
    aligned = generalised_procrustes(jnp.asarray(faces, jnp.float32))
    left = np.asarray(unstretched(aligned.aligned, aligned.mean) - aligned.mean)
    np.testing.assert_allclose((left * np.asarray(aligned.mean)).sum(1), 0, atol=1e-4)
