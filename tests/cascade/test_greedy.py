"""Training in a tiny world: it learns, repeats itself bit by bit, and a step is ridge regression on all samples."""

from dataclasses import replace
from functools import cache, partial

import jax
import numpy as np
import pytest
from blobs import FRAME, MEAN, SPACE, SPREAD, Patch, blob_faces, mean_error, shape_model_space, training_set
from jax import numpy as jnp
from scipy import ndimage

from jaxfit.cascade import greedy
from jaxfit.cascade.fit import fit_crops
from jaxfit.cascade.greedy import Greedy, SharedAxes, TrainingSet, sample_starts, train_cascade, with_copies
from jaxfit.cascade.starts import Spread, Starts
from jaxfit.cascade.state import State
from jaxfit.descriptors.descriptor import describe_point
from jaxfit.descriptors.sift import Sift
from jaxfit.errors import InputError
from jaxfit.image.disturb import Disturbance

COUNT = 40
CROPS, LANDMARKS = blob_faces(COUNT, seed=0)
NEW_CROPS, NEW_LANDMARKS = blob_faces(COUNT, seed=1)
START = MEAN + FRAME.middle


GREEDY = Greedy(windows=(0.9, 0.7, 0.5), augmentations=4, variance=1.0, ridge=0.1)


def trained(faces=None, descriptor=None, axes=None, progress=lambda *_: None, **changes):
    # All trainings here have arrays of the same sizes, because compiling takes longer than all else.
    faces = training_set(CROPS, LANDMARKS) if faces is None else faces
    options = replace(GREEDY, **changes)
    return train_cascade(SPACE, descriptor or Patch(), FRAME, faces, SPREAD, options, axes=axes, progress=progress)


@cache
def plain():
    """Trained without changes, once for all tests that look at it."""
    return trained()


# Compiled once; run as it is, it compiles each of its operations.
many_starts = jax.jit(partial(sample_starts, count=20_000, frame=FRAME))


def assert_same_bits(a, b):
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(one, other)


def error_after(cascade, steps, crops=CROPS, landmarks=LANDMARKS):
    """Mean error in pixels when the later steps do nothing."""
    kept = [float(number < steps) for number in range(len(cascade.weights))]
    weights = tuple(keep * of_step for keep, of_step in zip(kept, cascade.weights, strict=True))
    shortened = replace(cascade, weights=weights, biases=jnp.array(kept)[:, None] * cascade.biases)
    return mean_error(fit_crops(shortened, crops), landmarks)


def test_copies_show_at_their_landmarks_what_the_faces_show_and_depend_on_nothing_else():
    flipped = np.arange(COUNT) % 2 == 1
    faces = replace(training_set(CROPS, LANDMARKS), mirrored=flipped, numbers=np.arange(COUNT), of=COUNT)
    copied = with_copies(faces, 2, seed=0, amounts=Disturbance(blur=0.0, noise=0.0, hidden=0.0))
    assert (len(copied.source), copied.of) == (3 * COUNT, 3 * COUNT)
    np.testing.assert_array_equal(copied.numbers, np.arange(3 * COUNT))
    assert not copied.mirrored[COUNT:].any()

    def seen(faces, row):
        crop = faces.crops[faces.source[row]]
        crop = crop[:, ::-1] if faces.mirrored[row] else crop
        return ndimage.map_coordinates(crop.astype(float), faces.landmarks[row].T[::-1], order=1, mode="nearest")

    before, after = (np.array([seen(copied, row) for row in rows]) for rows in (range(COUNT), range(COUNT, 2 * COUNT)))
    assert np.abs(after - before).mean() < 10
    assert np.abs(copied.landmarks[COUNT : 2 * COUNT] - LANDMARKS).mean() > 0.5
    rows = np.array([3, 8])  # as another process has them
    own = replace(faces, source=rows, **{n: getattr(faces, n)[rows] for n in ("landmarks", "mirrored", "pivots")})
    own = with_copies(replace(own, numbers=rows), 2, seed=0)
    every = with_copies(faces, 2, seed=0)
    places = np.concatenate([rows, rows + COUNT, rows + 2 * COUNT])
    np.testing.assert_array_equal(own.numbers, places)
    np.testing.assert_array_equal(own.crops[own.source], every.crops[every.source[places]])
    np.testing.assert_array_equal(own.landmarks, every.landmarks[places])


@pytest.mark.parametrize(
    ("descriptor", "windows"), [(Patch(), (0.9, 0.7, 0.5)), (Sift(), (0.9,))], ids=["patch", "sift"]
)
def test_learns(descriptor, windows):
    cascade = plain() if descriptor == Patch() else trained(descriptor=descriptor, windows=windows)
    assert error_after(cascade, len(windows), NEW_CROPS, NEW_LANDMARKS) < 0.5 * mean_error(START, NEW_LANDMARKS)
    errors = [error_after(cascade, steps) for steps in range(len(windows) + 1)]
    assert errors == sorted(errors, reverse=True)
    np.testing.assert_allclose(cascade.windows, np.array(windows) * FRAME.face, rtol=1e-6)


def test_the_first_step_is_ridge_regression_on_the_dense_matrix(monkeypatch):
    landmarks = np.repeat(LANDMARKS[:, None], 4, 1)
    starts = landmarks + np.random.default_rng(0).normal(0, 2, landmarks.shape).astype(np.float32)
    monkeypatch.setattr(greedy, "draw_states", lambda *_: State(starts.reshape(COUNT, 4, -1), np.zeros((COUNT, 4))))
    cascade = trained(ridge=0.3)

    sizes = np.sqrt(((starts - starts.mean(2, keepdims=True)) ** 2).sum((2, 3)) / (MEAN**2).sum())
    prepared = jax.vmap(Patch().prepare)(CROPS)
    of_point = partial(describe_point, Patch())
    describe = jax.vmap(jax.vmap(jax.vmap(of_point, (None, 0, None, None)), (None, 0, 0, None)), (0, 0, 0, None))
    x = np.asarray(describe(prepared, starts, 0.9 * FRAME.face * sizes, jnp.float32(0)), np.float64).reshape(
        4 * COUNT, -1
    )
    y = ((landmarks - starts) / sizes[..., None, None]).astype(np.float64).reshape(4 * COUNT, -1)
    centred = x - x.mean(0)
    covariance = centred.T @ centred / len(x)
    penalty = 0.3 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    expected = y.mean(0) + centred @ np.linalg.solve(covariance + penalty, centred.T @ (y - y.mean(0)) / len(x))
    # The weights are rounded to 16 bits.
    np.testing.assert_allclose(x @ np.asarray(cascade.weights[0]) + np.asarray(cascade.biases[0]), expected, atol=0.02)


def test_few_directions_are_shared_by_all_samples_and_learn_too():
    cascade = trained(rank=5)
    assert [of_step.shape for of_step in cascade.weights] == [(len(plain().weights[0]), 5)] * 3
    products = np.einsum("srp,sqp->srq", cascade.directions, cascade.directions)
    np.testing.assert_allclose(products, np.tile(np.eye(5), (3, 1, 1)), atol=1e-5)
    # Places, sizes and rotations are four directions; by how much each blob is off its place are the others.
    assert error_after(cascade, 3, NEW_CROPS, NEW_LANDMARKS) < 0.5 * mean_error(START, NEW_LANDMARKS)


def test_as_many_directions_as_parameters_are_all():
    assert trained(rank=SPACE.size).directions is None
    assert_same_bits(trained(rank=SPACE.size), plain())


def test_shared_axes_are_found_once(monkeypatch):
    axes = SharedAxes(1.0)
    for one, other in zip(jax.tree.leaves(trained(axes=axes)), jax.tree.leaves(plain()), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)
    monkeypatch.setattr(greedy, "spectrum", None)  # not reached
    stronger = trained(axes=axes, ridge=1.0)
    for one, other in zip(stronger.weights, trained(axes=axes).weights, strict=True):
        assert np.linalg.norm(one) < np.linalg.norm(other)
    with pytest.raises(TypeError):  # reached: another window at one step
        trained(axes=axes, windows=(0.9, 0.7, 0.4))


def test_the_same_seed_gives_the_same_bits():
    assert_same_bits(plain(), trained())
    assert not np.array_equal(plain().weights[0], trained(seed=1).weights[0])


def test_weights_are_what_a_file_of_16_bits_keeps():
    weights = np.asarray(plain().weights)
    np.testing.assert_array_equal(weights, weights.astype(np.float16))


def test_a_mirrored_face_is_the_flipped_crop():
    # Half of the crops twice, as they are and mirrored, by sharing pixels and by copying them.
    half = COUNT // 2
    flipped = LANDMARKS[:, [1, 0, 3, 2]] * np.float32([-1, 1]) + np.float32([FRAME.crop - 1, 0])
    landmarks, flips = np.concatenate([LANDMARKS[:half], flipped[:half]]), np.repeat([False, True], half)
    copied = training_set(np.concatenate([CROPS[:half], CROPS[:half, :, ::-1]]), landmarks)
    shared = TrainingSet(CROPS[:half], landmarks, flips, np.tile(np.arange(half), 2), copied.pivots)
    cascade = trained(shared)
    assert_same_bits(cascade, trained(copied))
    assert error_after(cascade, 3, CROPS[:, :, ::-1], flipped) < 0.5 * mean_error(START, flipped)


def test_the_size_of_batches_does_not_matter(monkeypatch):
    whole = fit_crops(plain(), NEW_CROPS)
    monkeypatch.setattr(greedy, "_BATCH", 12)  # 3 faces at once, and the last batch is not full
    monkeypatch.setattr(greedy, "_PCA_SAMPLES", 100)  # 2 of the 4 samples of each face; they span all features, too
    np.testing.assert_allclose(fit_crops(trained(), NEW_CROPS), whole, atol=0.05)


def test_starts_have_the_spread_that_was_asked_for():
    spread = Spread((0.1, 0.3), 0.2, 0.4)
    starts = many_starts(jax.random.key(0), sigmas=spread.sigmas, turn=jnp.float32(0), pivot=jnp.zeros(2))
    np.testing.assert_allclose(starts.centre.mean(0), FRAME.middle, atol=0.2)
    np.testing.assert_allclose(starts.centre.std(0), np.array(spread.shift) * FRAME.face, rtol=0.03)
    for values, sigma in ((jnp.log(starts.scale), spread.log_scale), (starts.rotation, spread.rotation)):
        np.testing.assert_allclose([values.mean(), values.std()], [0, sigma], atol=0.03 * sigma)


@pytest.mark.parametrize("space", [SPACE, shape_model_space(LANDMARKS)], ids=["points", "asm"])
def test_turned_faces_are_found_from_several_starts(space):
    options = replace(GREEDY, windows=(0.9, 0.9, 0.7, 0.5), augmentations=12)
    cascade = train_cascade(
        space, Patch(turns=True, samples=5), FRAME, training_set(CROPS, LANDMARKS), SPREAD, options, turn=1.5
    )
    upright = mean_error(fit_crops(cascade, NEW_CROPS), NEW_LANDMARKS)
    assert upright < 0.6 * mean_error(START, NEW_LANDMARKS)
    for quarters in (-1, 1):
        crops = np.rot90(NEW_CROPS, -quarters, (1, 2)).copy()
        turn = np.array([[0, -quarters], [quarters, 0]])
        landmarks = (NEW_LANDMARKS - FRAME.middle) @ turn.T + FRAME.middle
        assert mean_error(START, landmarks) > 10
        assert mean_error(fit_crops(cascade, crops, Starts(7)), landmarks) < 2


def test_starts_are_turned_evenly_about_the_pivot():
    spread, pivot, turn = Spread((0.0, 0.0), 0.0, 0.0), jnp.array([20.0, 15.0]), jnp.float32(1.5)
    starts = many_starts(jax.random.key(0), sigmas=spread.sigmas, turn=turn, pivot=pivot)
    np.testing.assert_allclose(np.histogram(starts.rotation, 5, (-1.5, 1.5))[0], 4000, rtol=0.1)
    arms = np.asarray(starts.centre) - np.asarray(pivot)
    turns = np.arctan2(arms[:, 1], arms[:, 0]) - np.arctan2(8.5, 3.5)
    np.testing.assert_allclose(np.exp(1j * turns), np.exp(1j * np.asarray(starts.rotation)), atol=1e-4)
    np.testing.assert_allclose(np.hypot(*arms.T), np.hypot(3.5, 8.5), rtol=1e-4)


def test_progress_counts_up_within_each_stage():
    calls = {}
    trained(progress=lambda stage, done, total: calls.setdefault(stage, []).append((done, total)))
    assert len(calls) == 1 + 3 * 2 + 2  # starts; PCA and features of three steps; advancing after all but the last
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
        ({"ridge": -1.0}, "ridge, spread and seed >= 0"),
        ({"ridge": float("nan")}, "ridge, spread and seed >= 0"),
        ({"variance": 0.0}, "0 < variance <= 1"),
        ({"variance": 1.5}, "0 < variance <= 1"),
        ({"rank": 0}, "rank and augmentations >= 1"),
        ({"spread": -1.0}, "spread and seed >= 0"),
        ({"spread": float("inf")}, "spread and seed >= 0"),
        ({"seed": -1}, "spread and seed >= 0"),
    ],
    ids=str,
)
def test_impossible_options_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        Greedy(**changes)


@pytest.mark.parametrize(
    ("faces", "words"),
    [
        (training_set(CROPS[:0], LANDMARKS[:0]), "at least one face"),
        (training_set(np.zeros_like(CROPS), LANDMARKS), "nothing can be learned"),
    ],
    ids=["none", "black"],
)
def test_faces_that_teach_nothing_are_refused(faces, words):
    with pytest.raises(InputError, match=words):
        trained(faces)
