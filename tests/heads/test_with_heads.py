"""2D models with heads: their landmarks stay the same, and heads drawn at known poses are found."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.spatial.transform import Rotation

import jaxfit
from jaxfit.errors import InputError
from jaxfit.schemes.known import scheme_named


@pytest.fixture(scope="module")
def model() -> jaxfit.Model:
    return jaxfit.with_heads(jaxfit.load("face68"))


def test_heads_lie_at_landmarks_of_known_poses(model: jaxfit.Model) -> None:
    space = model.aligned
    assert space is not None
    mean = np.asarray(space.model.mean, np.float64)
    poses = np.random.default_rng(0).uniform([-40, -25, -60], [40, 25, 60], (20, 3))  # roll, pitch, yaw
    turned = Rotation.from_euler("YXZ", poses[:, [2, 1, 0]] * [1, -1, 1], degrees=True).as_matrix()
    seen = 0.8 * np.einsum("nij,lj->nli", turned, mean)[..., :2] + [100, 90]

    @jax.jit
    def found(points: jax.Array) -> tuple:
        params = jax.vmap(space.encode)(points)
        return tuple(jax.vmap(of)(params) for of in (space.pose, space.scale, space.landmarks, space.b))

    pose, scale, landmarks, b = found(jnp.asarray(seen, jnp.float32))
    np.testing.assert_allclose(pose, poses, atol=0.1)
    np.testing.assert_allclose(scale, 0.8, rtol=1e-3)
    np.testing.assert_allclose(landmarks, seen, atol=0.1)
    np.testing.assert_allclose(b / space.model.deviations, 0, atol=0.02)


def test_files_keep_them(model: jaxfit.Model, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    jaxfit.save(model, path)
    again = jaxfit.load(path)
    assert type(again.aligned) is type(model.aligned)
    for one, other in zip(jax.tree.leaves(again.aligned), jax.tree.leaves(model.aligned), strict=True):
        np.testing.assert_array_equal(one, other)


def test_models_that_find_heads_and_landmarks_of_other_things_are_refused() -> None:
    with pytest.raises(InputError, match="finds heads by itself"):
        jaxfit.with_heads(jaxfit.load("regression68-3d"))
    other = replace(jaxfit.load("face68"), scheme=scheme_named("points68"))
    with pytest.raises(InputError, match="no points of scheme points68"):
        jaxfit.with_heads(other)
