"""Teaching an uncertainty in a world whose errors are known: regions hold what they claim, and hidden is hidden."""

import jax
import numpy as np
import pytest
import scipy
from jax import numpy as jnp
from jax import random

from jaxfit.cascade.confidence import Clues
from jaxfit.cascade.regression import Projection
from jaxfit.cascade.uncertainty import FREEDOM, region_radius, shape_of
from jaxfit.evaluation.calibration import auroc, calibration_error
from jaxfit.learning.uncertainty import (
    Axes,
    Sighted,
    _like_neighbours,
    _with_covers,
    learned_uncertainty,
    standardised,
)

LANDMARKS, DESCRIPTOR, MOVES = 5, 3, 2
MEAN = np.array([[0.0, 0.0], [4.0, 0.0], [2.0, 2.0], [1.0, 4.0], [3.0, 4.0]])
WHOLE = LANDMARKS * DESCRIPTOR


def world(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Features, moves, landmarks, errors, their deviations, and what can be seen: errors grow with the first move, of
    each landmark with its own first feature; what looks unusual is hidden."""
    rng = np.random.default_rng(seed)
    features, moves = rng.normal(size=(count, LANDMARKS, DESCRIPTOR)), rng.normal(size=(count, MOVES))
    landmarks = 10 * MEAN + rng.normal(size=(count, LANDMARKS, 2))
    deviations = 0.05 * np.exp(0.5 * moves[:, :1] + 0.4 * features[..., 0])
    drawn = scipy.stats.multivariate_t(shape=[[1, 0.5], [0.5, 1]], df=FREEDOM, seed=seed).rvs((count, LANDMARKS))
    errors = deviations[..., None] * drawn
    seen = (features[..., 1] ** 2 + 0.3 * rng.normal(size=(count, LANDMARKS)) < 1.5).astype(float)
    return features.reshape(count, -1), moves, landmarks, errors, deviations, seen


@pytest.fixture(scope="module")
def learned():
    axes = Axes(Projection(jnp.zeros(WHOLE), jnp.eye(WHOLE)), Projection(jnp.zeros(DESCRIPTOR), jnp.eye(DESCRIPTOR)))
    folds = []
    for fold in range(2):
        features, moves, landmarks, errors, _, seen = world(4000, fold)
        errors[::3, 1] = np.nan  # labels that are missing
        seen[::4, 2] = np.nan
        shapes = np.asarray(jax.vmap(shape_of)(jnp.asarray(landmarks))).reshape(len(landmarks), -1)
        own = features.reshape(len(features), LANDMARKS, DESCRIPTOR)
        folds.append(Sighted(np.concatenate([features, moves, shapes], 1), own, errors, seen))
    return learned_uncertainty(folds, axes, 0)


def test_regions_hold_what_they_claim_and_hidden_is_told_from_visible(learned) -> None:
    features, moves, landmarks, errors, deviations, seen = world(4000, 7)
    clues = Clues(jnp.asarray(features, jnp.float32), jnp.asarray(moves, jnp.float32))
    points = jnp.asarray(landmarks, jnp.float32)
    raw = np.asarray(jax.vmap(learned.raw)(clues, points))
    lengths = standardised(raw, errors)
    for share in (0.5, 0.9, 0.95):
        assert (lengths <= region_radius(share)).mean() == pytest.approx(share, abs=0.03)
    # In the quarters of faces that err least and most, too.
    quarters = np.digitize(moves[:, 0], np.quantile(moves[:, 0], [0.25, 0.5, 0.75]))
    for quarter in range(4):
        assert (lengths[quarters == quarter] <= region_radius(0.9)).mean() == pytest.approx(0.9, abs=0.05)
    assert np.corrcoef(raw[..., 0].ravel(), np.log(deviations).ravel())[0, 1] > 0.9
    doubts = jax.vmap(learned)(clues, points)
    correlation = doubts.covariances[..., 0, 1] / doubts.covariances[..., 0, 0]
    np.testing.assert_allclose(correlation.mean(), 0.5, atol=0.1)
    visible = np.asarray(doubts.visible)
    assert auroc(visible.ravel(), seen.ravel() == 1) > 0.9
    assert calibration_error(visible.ravel(), seen.ravel() == 1) < 0.05


def test_files_keep_it(learned) -> None:
    """What is stored in 16 bits was rounded to them."""
    for part in (learned.seen, learned.axes):
        np.testing.assert_array_equal(part, np.asarray(part).astype(np.float16).astype(np.float32))


def test_covers_hide_what_lies_below_them() -> None:
    crops = np.random.default_rng(0).integers(0, 256, (80, 30, 30)).astype(np.uint8)
    points = np.random.default_rng(1).uniform(0, 29, (80, 6, 2))
    covered, hidden = _with_covers(random.key(0), crops, points)
    assert covered.shape == crops.shape
    places = np.round(points).astype(int)
    faces = np.arange(80)[:, None]
    changed = (covered != crops)[faces, places[..., 1], places[..., 0]]
    assert 0.02 < hidden.mean() < 0.2
    assert (changed == hidden).mean() > 0.97  # but for points on the edge
    assert 0.3 < (covered != crops).any((1, 2)).mean() < 0.6


def test_unknown_landmarks_are_like_their_neighbours() -> None:
    seen = np.array([[0, 1, np.nan, np.nan, np.nan], [1, 0, np.nan, 0, 1.0]])
    np.testing.assert_array_equal(_like_neighbours(seen, MEAN)[1], [1, 0, 0, 0, 1])
    np.testing.assert_array_equal(_like_neighbours(seen[:1], MEAN)[0, [0, 1, 3]], [0, 1, 0])
    nothing = np.full((1, 5), np.nan)
    assert np.isnan(_like_neighbours(nothing, MEAN)).all()
