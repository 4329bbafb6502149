"""The shape model against NumPy's PCA, and the laws of its ellipsoid; in two and three dimensions."""

from functools import cache

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from jaxfit.errors import InputError
from jaxfit.shapes.asm import learn_shape_model, likely_radius

DIMENSIONS = pytest.mark.parametrize("dimensions", [2, 3])


def faces(dimensions, count=60, points=6):
    rng = np.random.default_rng(dimensions)
    mixing = rng.normal(size=(points * dimensions, points * dimensions)) * np.geomspace(8, 0.2, points * dimensions)
    flat = rng.normal(size=(count, points * dimensions)) @ mixing.T + rng.normal(0, 30, points * dimensions)
    return flat.reshape(count, points, dimensions).astype(np.float32)


@cache
def learned(dimensions, share):
    return learn_shape_model(jnp.asarray(faces(dimensions)), share)


# Compiled once for each size of model.
encode = jax.jit(lambda model, face: model.encode(face))
reconstruct = jax.jit(lambda model, b: model.reconstruct(b))


def numpy_pca(given):
    flat = given.reshape(len(given), -1).astype(np.float64)
    variances, axes = np.linalg.eigh(np.cov(flat.T, bias=True))
    return variances[::-1], axes[:, ::-1].T


@DIMENSIONS
def test_is_numpys_pca(dimensions):
    given = faces(dimensions)
    model = learned(dimensions, 1.0)
    variances, axes = numpy_pca(given)
    np.testing.assert_allclose(model.mean, given.mean(0), atol=1e-4)
    np.testing.assert_allclose(model.deviations, np.sqrt(variances), rtol=1e-3)
    along = np.abs(np.asarray(model.modes).reshape(len(axes), -1) @ axes.T)  # modes have no sign
    np.testing.assert_allclose(along, np.eye(len(axes)), atol=0.02)


@DIMENSIONS
@pytest.mark.parametrize("share", [0.3, 0.8, 0.95, 0.999])
def test_keeps_the_fewest_modes_that_hold_the_share(dimensions, share):
    model = learned(dimensions, share)
    variances, _ = numpy_pca(faces(dimensions))
    held = np.cumsum(variances) / variances.sum()
    kept = len(model.deviations)
    assert held[kept - 1] >= share
    assert kept == 1 or held[kept - 2] < share
    assert model.modes.shape == (kept, 6, dimensions)


@DIMENSIONS
def test_with_all_modes_every_face_is_encoded_exactly(dimensions):
    given, model = faces(dimensions), learned(dimensions, 1.0)
    found = [reconstruct(model, encode(model, face)) for face in given]
    np.testing.assert_allclose(found, given, atol=1e-3)


@DIMENSIONS
def test_encoding_undoes_reconstruction_and_is_the_nearest(dimensions):
    given, model = faces(dimensions), learned(dimensions, 0.8)
    b = model.deviations * np.linspace(-2, 2, len(model.deviations), dtype=np.float32)
    np.testing.assert_allclose(encode(model, reconstruct(model, b)), b, atol=1e-3)
    left = given[0] - np.asarray(reconstruct(model, encode(model, given[0])))
    np.testing.assert_allclose(np.tensordot(model.modes, left, 2), 0, atol=1e-3)


def test_the_ellipsoid():
    model = learned(2, 0.9)
    rng = np.random.default_rng(0)
    for radius in (0.0, 1.0, 2.999, 3.001, 50.0):
        direction = rng.normal(size=len(model.deviations))
        b = jnp.asarray(radius * direction / np.linalg.norm(direction), jnp.float32) * model.deviations
        pulled = model.restrict(b)
        inside = min(radius, 3.0)
        assert np.linalg.norm(pulled / model.deviations) == pytest.approx(inside, rel=1e-5, abs=1e-6)
        np.testing.assert_allclose(model.restrict(pulled), pulled, rtol=1e-6)  # twice is once
        np.testing.assert_allclose(pulled * radius, b * inside, rtol=1e-4, atol=1e-5)  # straight back
        assert np.linalg.norm(model.restrict(b, 1.5) / model.deviations) <= 1.5 + 1e-5


def test_pulling_back_has_finite_derivatives_everywhere():
    model = learned(2, 0.9)
    slope = jax.jit(jax.jacobian(model.restrict))
    for radius in (0.0, 1.0, 3.0, 1e4):
        b = jnp.zeros(len(model.deviations)).at[0].set(radius * model.deviations[0])
        assert np.isfinite(slope(b)).all()
    np.testing.assert_array_equal(slope(jnp.zeros(len(model.deviations))), np.eye(len(model.deviations)))


@pytest.mark.parametrize("share", [0.0, -1.0, 1.1, float("nan")])
def test_impossible_shares_are_refused(share):
    with pytest.raises(InputError, match="0 < variance <= 1"):
        learn_shape_model(jnp.asarray(faces(2)), share)


def test_equal_faces_are_refused():
    with pytest.raises(InputError, match="same shape"):
        learn_shape_model(jnp.asarray(np.repeat(faces(2)[:1], 5, 0)), 0.95)


@pytest.mark.parametrize("modes", [1, 10, 40])
def test_the_likely_radius_holds_as_many_as_three_sigma_in_one_dimension(modes):
    normal = np.random.default_rng(0).normal(size=(200_000, modes))
    outside = (np.linalg.norm(normal, axis=1) > likely_radius(modes)).mean()
    assert outside == pytest.approx(0.0027, abs=0.0006)
    assert modes > 1 or likely_radius(modes) == pytest.approx(3)
