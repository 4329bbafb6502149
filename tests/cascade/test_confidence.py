"""Clues do not depend on where and how large a face is; what a confidence says changes nothing of the fits."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="arg-type,index"

from dataclasses import replace

import jax
import numpy as np
import pytest
from blobs import FRAME, SPACE, SPREAD, Patch, blob_faces, training_set
from jax import numpy as jnp

from jaxfit.cascade.confidence import Clues, Confidence, count_moves
from jaxfit.cascade.confidence import moves_of as moves_of_arrays
from jaxfit.cascade.fit import find as find_unjitted
from jaxfit.cascade.fit import find_clues, fit_crops
from jaxfit.cascade.greedy import Greedy, train_cascade
from jaxfit.cascade.model import first_steps
from jaxfit.cascade.starts import Starts
from jaxfit.shapes.space import rotate

STEPS = 2
RNG = np.random.default_rng(5)
PATH = np.float32(RNG.normal(0, 9, (6, 2)) + RNG.normal(0, 1, (4, 6, 2)) + 30)
OTHERS = PATH[-1] + np.float32(RNG.normal(0, 2, (5, 6, 2)))
SHIFT, SCALE, ROTATION, SHAPE, SPREAD_OF_FITS = slice(3, 5), 5, 6, 7, 8

find = jax.jit(find_unjitted)


def moves_of(path, others):
    return moves_of_arrays(jnp.asarray(path, jnp.float32), jnp.asarray(others, jnp.float32))


@pytest.fixture(scope="module")
def cascade():
    crops, landmarks = blob_faces(60, seed=1)
    options = Greedy(windows=(0.6, 0.4), augmentations=3, variance=0.95, ridge=1.0)
    return train_cascade(SPACE, Patch(), FRAME, training_set(crops, landmarks), SPREAD, options)


def confidence_of(features: int, moves: int, hidden: int = 5) -> Confidence:
    rng = np.random.default_rng(2)
    sizes = [(features, hidden), (moves, hidden), (hidden,), (hidden,), ()]
    return Confidence(*(jnp.asarray(0.3 * rng.normal(size=size), jnp.float32) for size in sizes))


def test_places_and_sizes_do_not_matter() -> None:
    moves = moves_of(PATH, OTHERS)
    assert moves.shape == (count_moves(len(PATH) - 1),)
    np.testing.assert_allclose(moves_of(3.5 * PATH + 100, 3.5 * OTHERS + 100), moves, atol=2e-4)


def test_moves_say_how_the_fit_came_about() -> None:
    start = PATH[0]
    middle = start.mean(0)
    size = np.sqrt(np.mean(np.sum((start - middle) ** 2, 1)))
    found = np.asarray(rotate(jnp.asarray(2 * (start - middle)), jnp.float32(0.3))) + middle + [4, -7]
    moves = np.asarray(moves_of(np.stack([start, start, start, found]), found[None]))
    np.testing.assert_allclose(moves[:2], np.log(1e-3 + 1e-3 / (2 * size)), atol=0.05)  # no steps
    np.testing.assert_allclose(moves[SHIFT], np.array([4, -7]) / (2 * size), atol=1e-4)
    np.testing.assert_allclose(moves[[SCALE, ROTATION]], [np.log(2), 0.3], atol=1e-4)
    assert moves[SHAPE] < np.log(5e-3)  # the same shape
    stretched = np.stack([start, start, start, (start - middle) * [1, 1.5] + middle])
    assert moves_of(stretched, stretched[-1:])[SHAPE] > np.log(0.05)


def test_the_spread_is_that_of_the_other_fits() -> None:
    alone = moves_of(PATH, PATH[-1:])
    near, far = (moves_of(PATH, PATH[-1] + factor * (OTHERS - PATH[-1])) for factor in (1, 3))
    assert alone[SPREAD_OF_FITS] < near[SPREAD_OF_FITS]
    assert far[SPREAD_OF_FITS] - near[SPREAD_OF_FITS] == pytest.approx(np.log(3), abs=0.02)
    np.testing.assert_array_equal(np.delete(alone, SPREAD_OF_FITS), np.delete(near, SPREAD_OF_FITS))


def test_a_face_that_collapsed_has_finite_moves() -> None:
    path = np.concatenate([PATH[:2], np.full((2, 6, 2), 7.0)])
    assert jnp.isfinite(moves_of(path, path[-1:])).all()


@pytest.mark.parametrize("starts", [Starts(), Starts(3, -25.0, 25.0)], ids=["one start", "three"])
def test_a_confidence_changes_nothing_and_is_that_of_the_best_fit(cascade, starts) -> None:
    crops, _ = blob_faces(6, seed=9)
    features = cascade.weights[0].shape[0]
    confidence = confidence_of(features, count_moves(STEPS))
    found = find(cascade, None, crops, starts.rotations, confidence=confidence)
    landmarks, clues = find_clues(cascade, crops, starts.rotations)
    np.testing.assert_array_equal(landmarks, fit_crops(cascade, crops, starts))
    np.testing.assert_allclose(found["landmarks"], landmarks, atol=1e-4)
    hidden = np.tanh(clues.features @ confidence.seen + clues.moves @ confidence.moved + confidence.biases)
    odds = hidden @ confidence.output + confidence.offset
    np.testing.assert_allclose(found["confidence"], 1 / (1 + np.exp(-odds)), atol=1e-5)


def test_clues_are_what_the_last_step_saw_and_how_it_got_there(cascade) -> None:
    crops, _ = blob_faces(3, seed=9)
    steps = np.stack([fit_crops(first_steps(cascade, count), crops) for count in range(1, STEPS + 1)], 1)
    start = SPACE.landmarks(jnp.ravel(SPACE.mean + FRAME.middle))
    landmarks, clues = find_clues(cascade, crops, Starts().rotations)
    for face in range(len(crops)):
        moves = moves_of(jnp.concatenate([start[None], steps[face]]), landmarks[face][None])
        np.testing.assert_allclose(clues.moves[face], moves, atol=1e-3)
    # The last step is what its regressor makes of these features.
    step = clues.features @ cascade.weights[-1] + cascade.biases[-1]
    scales = jax.vmap(SPACE.scale)(steps[:, -2].reshape(len(crops), -1))
    moved = steps[:, -2].reshape(len(crops), -1) + scales[:, None] * step
    np.testing.assert_allclose(moved, landmarks.reshape(len(crops), -1), atol=1e-3)


def test_a_fit_that_diverged_has_no_confidence(cascade) -> None:
    wild = replace(cascade, biases=cascade.biases.at[0].set(jnp.nan))
    crops, _ = blob_faces(2, seed=0)
    confidence = confidence_of(cascade.weights[0].shape[0], count_moves(STEPS))
    assert jnp.isnan(find(wild, None, crops, Starts().rotations, confidence=confidence)["confidence"]).all()


def test_probabilities_grow_with_their_logits() -> None:
    confidence = confidence_of(7, 3)
    clues = Clues(
        jnp.asarray(RNG.normal(size=(20, 7)), jnp.float32), jnp.asarray(RNG.normal(size=(20, 3)), jnp.float32)
    )
    order = jnp.argsort(jax.vmap(confidence.logit)(clues))
    probabilities = jax.vmap(confidence)(clues)[order]
    assert (jnp.diff(probabilities) >= 0).all()
    assert 0 <= probabilities[0] < probabilities[-1] <= 1
