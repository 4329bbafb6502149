"""Training in a tiny world: it learns, repeats itself bit by bit, and one step is ridge regression on dense matrices."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from blobs import FRAME, MEAN, SPACE, SPREAD, Patch, blob_faces, mean_error, training_set
from jax import numpy as jnp

from jaxfit.cascade import train
from jaxfit.cascade.fit import fit_crops
from jaxfit.cascade.train import Spread, TrainingSet, sample_starts, train_cascade
from jaxfit.descriptors.sift import Sift
from jaxfit.exceptions import InputError

COUNT = 40
CROPS, LANDMARKS = blob_faces(COUNT, seed=0)
NEW_CROPS, NEW_LANDMARKS = blob_faces(30, seed=1)


def trained(faces=None, descriptor=None, spread=SPREAD, **changes):
    options = {"windows": (0.8, 0.5), "augmentations": 4, "variance": 0.98, "ridge": 0.1, "seed": 0} | changes
    faces = faces or training_set(CROPS, LANDMARKS)
    return train_cascade(SPACE, descriptor or Patch(), FRAME, faces, spread, **options)


def assert_same_bits(a, b):
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(one, other)


def first_steps(cascade, count):
    return replace(
        cascade, weights=cascade.weights[:count], biases=cascade.biases[:count], windows=cascade.windows[:count]
    )


@pytest.mark.parametrize("descriptor", [Sift(), Patch()], ids=["sift", "patch"])
def test_learns(descriptor):
    cascade = trained(descriptor=descriptor, windows=(0.9, 0.7, 0.5))
    unseen = mean_error(fit_crops(cascade, NEW_CROPS), NEW_LANDMARKS)
    assert unseen < 0.5 * mean_error(MEAN + FRAME.middle, NEW_LANDMARKS)
    errors = [mean_error(fit_crops(first_steps(cascade, steps), CROPS), LANDMARKS) for steps in (0, 1, 2, 3)]
    assert errors == sorted(errors, reverse=True)
    np.testing.assert_allclose(cascade.windows, np.array([0.9, 0.7, 0.5]) * FRAME.face, rtol=1e-6)


@pytest.mark.parametrize("ridge", [0.01, 1.0])
def test_a_step_is_ridge_regression_on_the_dense_matrix(ridge):
    # Without spread every sample starts at the mean face: the features can be made without the training's code.
    descriptor = Patch(samples=3)
    cascade = trained(
        None, descriptor, Spread((0.0, 0.0), 0.0, 0.0), windows=(0.6,), augmentations=1, variance=1.0, ridge=ridge
    )
    side = jnp.float32(0.6 * FRAME.face)
    prepared = jax.vmap(descriptor.prepare)(CROPS)
    describe = jax.vmap(jax.vmap(descriptor.describe, (None, 0, None)), (0, None, None))
    x = np.asarray(describe(prepared, MEAN + FRAME.middle, side), np.float64).reshape(COUNT, -1)
    y = (LANDMARKS - MEAN - FRAME.middle).reshape(COUNT, -1).astype(np.float64)
    centred = x - x.mean(0)
    covariance = centred.T @ centred / COUNT
    penalty = ridge * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    weights = np.linalg.solve(covariance + penalty, centred.T @ (y - y.mean(0)) / COUNT)
    expected = y.mean(0) + centred @ weights
    # The weights are rounded to 16 bits.
    np.testing.assert_allclose(x @ np.asarray(cascade.weights[0]) + np.asarray(cascade.biases[0]), expected, atol=0.02)


def test_the_same_seed_gives_the_same_bits():
    cascade = trained()
    assert_same_bits(cascade, trained())
    assert not np.array_equal(cascade.weights, trained(seed=1).weights)


def test_weights_are_what_a_file_of_16_bits_keeps():
    weights = np.asarray(trained().weights)
    np.testing.assert_array_equal(weights, weights.astype(np.float16))


def test_a_mirrored_face_is_the_flipped_crop():
    # Every crop twice, as it is and mirrored, by sharing pixels and by copying them.
    flipped = LANDMARKS[:, [1, 0, 3, 2]] * np.float32([-1, 1]) + np.float32([FRAME.crop - 1, 0])
    landmarks, halves = np.concatenate([LANDMARKS, flipped]), np.repeat([False, True], COUNT)
    shared = TrainingSet(CROPS, landmarks, halves, np.tile(np.arange(COUNT), 2))
    copied = training_set(np.concatenate([CROPS, CROPS[:, :, ::-1]]), landmarks)
    cascade = trained(shared)
    assert_same_bits(cascade, trained(copied))
    assert mean_error(fit_crops(cascade, CROPS[:, :, ::-1]), flipped) < 0.5 * mean_error(MEAN + FRAME.middle, flipped)


def test_the_size_of_batches_does_not_matter(monkeypatch):
    whole = fit_crops(trained(), NEW_CROPS)
    monkeypatch.setattr(train, "_BATCH", 12)  # 3 faces at once, and the last batch is not full
    np.testing.assert_allclose(fit_crops(trained(), NEW_CROPS), whole, atol=0.05)


def test_axes_from_some_of_the_samples_do(monkeypatch):
    monkeypatch.setattr(train, "_PCA_SAMPLES", 25)
    assert mean_error(fit_crops(trained(), NEW_CROPS), NEW_LANDMARKS) < 0.6 * mean_error(
        MEAN + FRAME.middle, NEW_LANDMARKS
    )


def test_starts_have_the_spread_that_was_asked_for():
    spread = Spread((0.1, 0.3), 0.2, 0.4)
    starts = sample_starts(jax.random.key(0), 20_000, FRAME, spread)
    np.testing.assert_allclose(starts.centre.mean(0), FRAME.middle, atol=0.2)
    np.testing.assert_allclose(starts.centre.std(0), np.array(spread.shift) * FRAME.face, rtol=0.03)
    for values, sigma in ((jnp.log(starts.scale), spread.log_scale), (starts.rotation, spread.rotation)):
        np.testing.assert_allclose([values.mean(), values.std()], [0, sigma], atol=0.03 * sigma)


def test_progress_counts_up_within_each_stage():
    calls = {}
    trained(progress=lambda stage, done, total: calls.setdefault(stage, []).append((done, total)))
    assert len(calls) == 1 + 2 * 2 + 1  # starts; PCA and features of two steps; advancing after the first
    for done, total in (zip(*stage, strict=True) for stage in calls.values()):
        assert len({*total}) == 1
        assert list(done) == sorted({*done})
        assert done[-1] <= total[0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"windows": ()}, "at least one step"),
        ({"windows": (0.5, 0.0)}, "windows > 0"),
        ({"windows": (0.5, float("nan"))}, "windows > 0"),
        ({"augmentations": 0}, "augmentations >= 1"),
        ({"ridge": -1.0}, "ridge >= 0"),
        ({"ridge": float("nan")}, "ridge >= 0"),
        ({"variance": 0.0}, "0 < variance <= 1"),
        ({"variance": 1.5}, "0 < variance <= 1"),
        ({"faces": training_set(CROPS[:0], LANDMARKS[:0])}, "at least one face"),
        ({"faces": training_set(np.zeros_like(CROPS), LANDMARKS)}, "nothing can be learned"),
    ],
)
def test_impossible_options_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        trained(**changes)
