"""Least squares from moments, and PCA, against numpy on the tall matrices in float64."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from jaxfit.cascade.regression import Moments, main_directions, principal_axes, solve, spectrum
from jaxfit.errors import InputError

SAMPLES, FEATURES, PARAMS = 80, 6, 3


def samples(seed=0, features=FEATURES):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(SAMPLES, features)) * np.geomspace(3, 0.2, features) + 0.3
    y = x @ rng.normal(size=(features, PARAMS)) + 0.5 * rng.normal(size=(SAMPLES, PARAMS)) - 2
    return x.astype(np.float32), y.astype(np.float32)


def moments(x, y, weights=None):
    weights = np.ones(len(x)) if weights is None else weights
    empty = Moments.empty(x.shape[1], y.shape[1])
    return empty.add(jnp.asarray(x), jnp.asarray(y), jnp.asarray(weights, jnp.float32))


def assert_same(a, b):
    for found, expected in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-3)


def test_plain_least_squares_is_lstsq_with_an_intercept():
    x, y = samples()
    weights, bias = solve(moments(x, y), jnp.float32(0))
    tall = np.concatenate([x, np.ones((SAMPLES, 1))], 1).astype(np.float64)
    expected = np.linalg.lstsq(tall, y.astype(np.float64), rcond=None)[0]
    np.testing.assert_allclose(weights, expected[:-1], atol=2e-4)
    np.testing.assert_allclose(bias, expected[-1], atol=2e-4)


@pytest.mark.parametrize("ridge", [0.01, 0.5, 100.0])
def test_ridge_is_the_closed_form_with_a_free_intercept(ridge):
    x, y = samples()
    weights, bias = solve(moments(x, y), jnp.float32(ridge))
    centred_x, centred_y = (a.astype(np.float64) - a.mean(0, dtype=np.float64) for a in (x, y))
    covariance = centred_x.T @ centred_x / SAMPLES
    penalty = ridge * np.trace(covariance) / FEATURES * np.eye(FEATURES)
    expected = np.linalg.solve(covariance + penalty, centred_x.T @ centred_y / SAMPLES)
    np.testing.assert_allclose(weights, expected, atol=2e-4)
    np.testing.assert_allclose(bias, y.mean(0) - x.mean(0) @ expected, atol=2e-4)


@pytest.mark.parametrize("rank", [1, 2])
def test_along_the_main_directions_predictions_come_nearest_to_all(rank):
    # Of all predictions of that rank, the ones that numpy's singular vectors give are nearest (Eckart and Young).
    x, y = samples()
    weights, _ = solve(moments(x, y), jnp.float32(0.1))
    predicted = (x - x.mean(0)).astype(np.float64) @ np.asarray(weights, np.float64)
    left, values, right = np.linalg.svd(predicted, full_matrices=False)
    directions = np.asarray(main_directions(moments(x, y), weights, rank))
    np.testing.assert_allclose(directions @ directions.T, np.eye(rank), atol=1e-5)
    nearest = left[:, :rank] * values[:rank] @ right[:rank]
    np.testing.assert_allclose(predicted @ directions.T @ directions, nearest, atol=2e-3)


@pytest.mark.parametrize("ridge", [0.0, 0.1])
def test_dependent_features_share_the_weight(ridge):
    # Repeated and constant features: of all solutions the one of least norm, as numpy's.
    x, y = samples()
    deficient = np.concatenate([x, x[:, :2], np.full((SAMPLES, 1), 0.7, np.float32)], 1)
    weights, bias = solve(moments(deficient, y), jnp.float32(ridge))
    assert np.isfinite(weights).all()
    np.testing.assert_allclose(weights[:2], weights[FEATURES : FEATURES + 2], atol=1e-3)
    np.testing.assert_allclose(weights[-1], 0, atol=1e-3)
    if ridge == 0:
        plain_weights, plain_bias = solve(moments(x, y), jnp.float32(0))
        np.testing.assert_allclose(deficient @ weights + bias, x @ plain_weights + plain_bias, atol=1e-3)


def test_fewer_samples_than_features():
    x, y = samples(features=FEATURES + 3)
    weights, bias = solve(moments(x[:5], y[:5]), jnp.float32(0))
    np.testing.assert_allclose(x[:5] @ weights + bias, y[:5], atol=1e-2)


def test_features_that_never_change_predict_the_mean():
    _, y = samples()
    weights, bias = solve(moments(np.zeros((SAMPLES, FEATURES), np.float32), y), jnp.float32(0.5))
    np.testing.assert_array_equal(weights, 0)
    np.testing.assert_allclose(bias, y.mean(0), atol=1e-5)


def test_moments_of_batches_are_the_moments_of_all():
    x, y = samples()
    total = Moments.empty(FEATURES, PARAMS)
    for rows in np.split(np.arange(SAMPLES), [1, 30, 77]):
        total = total.add(jnp.asarray(x[rows]), jnp.asarray(y[rows]), jnp.ones(len(rows)))
    assert_same(total, moments(x, y))


def test_weight_zero_leaves_a_sample_out():
    x, y = samples()
    keep = np.random.default_rng(1).uniform(size=SAMPLES) < 0.6
    assert_same(moments(x, y, keep), moments(x[keep], y[keep]))


@pytest.mark.parametrize("shape", [(60, 8), (8, 60)])
@pytest.mark.parametrize("variance", [0.5, 0.9, 0.999])
def test_principal_axes_are_those_of_the_svd(shape, variance):
    rng = np.random.default_rng(0)
    count = min(shape)
    x = (rng.normal(size=(shape[0], count)) * np.geomspace(4, 0.5, count)) @ rng.normal(size=(count, shape[1])) + 2
    x = x.astype(np.float32)
    found = principal_axes(jnp.asarray(x), variance)
    mean = x.mean(0, dtype=np.float64)
    _, singular_values, axes = np.linalg.svd(x - mean, full_matrices=False)
    share = np.cumsum(singular_values**2) / np.sum(singular_values**2)
    kept = np.argmax(share >= variance) + 1

    np.testing.assert_allclose(found.mean, mean, atol=1e-4)
    assert found.axes.shape == (shape[1], kept)
    np.testing.assert_allclose(found.axes.T @ found.axes, np.eye(kept), atol=2e-3)
    # Axes have no sign, and those of nearly equal variance mix: compare what they span, from the first one on.
    for first in range(1, kept + 1):
        span = np.asarray(found.axes)[:, :first]
        ratio = singular_values[first] / singular_values[first - 1] if first < len(singular_values) else 0
        if ratio < 0.95:
            np.testing.assert_allclose(span @ span.T, axes[:first].T @ axes[:first], atol=5e-3)


@pytest.mark.parametrize("variance", [0.5, 0.8, 0.95, 1.0])
def test_one_spectrum_serves_every_share_of_variance(variance):
    x, _ = samples()
    whole, alone = spectrum(jnp.asarray(x), 0.97).keeping(variance), principal_axes(jnp.asarray(x), min(variance, 0.97))
    assert whole.axes.shape == alone.axes.shape
    np.testing.assert_allclose(whole.axes, alone.axes, atol=1e-5)
    np.testing.assert_array_equal(whole.mean, alone.mean)


@pytest.mark.parametrize("rank", [1, 3, 8])
@pytest.mark.parametrize("shape", [(60, 8), (8, 60)])
def test_axes_of_all_variance_rebuild_the_features(shape, rank):
    rng = np.random.default_rng(0)
    x = (rng.normal(size=(shape[0], rank)) @ rng.normal(size=(rank, shape[1])) + 5).astype(np.float32)
    found = principal_axes(jnp.asarray(x), 1.0)
    kept = found.axes.shape[1]
    assert kept <= rank
    np.testing.assert_allclose(found.axes.T @ found.axes, np.eye(kept), atol=2e-3)
    np.testing.assert_allclose((x - found.mean) @ found.axes @ found.axes.T + found.mean, x, atol=1e-3)


@pytest.mark.parametrize("shape", [(60, 8), (8, 60), (1, 8)])
@pytest.mark.parametrize("value", [0.0, 0.1, 0.3, 0.7])
def test_equal_samples_teach_nothing(shape, value):
    with pytest.raises(InputError, match="features of all samples are equal"):
        principal_axes(jnp.full(shape, value), 0.9)


@pytest.mark.parametrize("variance", [0.0, -0.1, 1.1, float("nan")])
def test_impossible_shares_of_variance_are_refused(variance):
    with pytest.raises(InputError, match="0 < variance <= 1"):
        principal_axes(jnp.ones((3, 2)), variance)
