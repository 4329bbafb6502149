"""Fine-tuning in a tiny world: gradients are those of finite differences; it learns, repeats itself and goes on."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
from blobs import FRAME, SPACE, SPREAD, Patch, blob_faces, mean_error, training_set
from jax import numpy as jnp
from jax import random

from jaxfit.cascade import tuning
from jaxfit.cascade.fit import fit_crops
from jaxfit.cascade.greedy import Greedy, train_cascade
from jaxfit.cascade.tuning import Learned, Tuning, finetune_cascade
from jaxfit.descriptors.dense import Dense
from jaxfit.errors import InputError
from jaxfit.image.disturb import Disturbance

COUNT = 40
FACES = training_set(*blob_faces(COUNT, seed=0))
NEW_CROPS, NEW_LANDMARKS = blob_faces(COUNT, seed=1)
CHECK = training_set(NEW_CROPS, NEW_LANDMARKS)
MILD = Disturbance(0.05, 0.03, 0.0, 0.0, 0.0, 0.0)
CAUTIOUS = Greedy(windows=(0.9, 0.6), augmentations=4, variance=1.0, ridge=3.0)
TUNING = Tuning(epochs=10, rate=0.1, batch=10, dropped=0.1, disturbance=MILD)


@cache
def greedy(descriptor=Patch(), rank=None):  # noqa: B008
    """A cascade that was trained too cautiously."""
    return train_cascade(SPACE, descriptor, FRAME, FACES, SPREAD, replace(CAUTIOUS, rank=rank))


@cache
def tuned(faces="all", seed=0):
    """The cascade, and the errors on the way."""
    return finetune_cascade(greedy(), FACES, CHECK, SPREAD, replace(TUNING, seed=seed))


def learned_of(cascade):
    return Learned(cascade.weights, cascade.biases, cascade.directions, cascade.hidden)


def with_hidden(cascade, seed=0):
    """The cascade with hidden units that do something."""
    cascade = tuning._with_units(cascade, replace(TUNING, units=6))
    output = 0.5 * random.normal(random.key(seed), cascade.hidden.output.shape, jnp.float32)
    return replace(cascade, hidden=cascade.hidden._replace(output=output))


def assert_same_bits(a, b):
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(one, other)


def loss_of(cascade, landmarks=None, dropped=0.0):
    """The loss as a function of what is learned."""
    faces = FACES if landmarks is None else replace(FACES, landmarks=landmarks)
    batch = tuning._upright(tuning._batch_of(faces, tuning._depths(cascade, faces), np.arange(8)))
    drawn = tuning._Drawn(SPREAD.sigmas, jnp.float32(0))
    states = tuning._starts(cascade, random.split(random.key(0), 8), batch.pivots, drawn)
    levels = tuning._levels(cascade)

    @jax.jit
    def loss(learned):
        return tuning._loss(tuning._with(cascade, learned), levels, batch, states, random.key(1), dropped)

    return loss


@pytest.mark.parametrize(
    "cascade",
    [
        greedy,
        lambda: greedy(rank=5),
        lambda: greedy(Dense()),
        lambda: greedy(Patch(turns=True)),
        lambda: with_hidden(greedy(rank=5)),
    ],
    ids=["patch", "few directions", "dense", "turning", "hidden units"],
)
def test_gradients_are_those_of_finite_differences(cascade):
    cascade = cascade()
    learned, loss = learned_of(cascade), loss_of(cascade, dropped=0.2)
    gradient = jax.grad(loss)(learned)
    rng = np.random.default_rng(0)
    for part in range(len(jax.tree.leaves(learned))):
        leaves, structure = jax.tree.flatten(learned)
        slopes = jax.tree.leaves(gradient)[part]
        # Along the gradient with random weights: uphill, so that float32 sees a difference, but not one direction only.
        towards = jnp.asarray(slopes * rng.uniform(0.2, 1, slopes.shape), jnp.float32)
        step = 0.01 * jnp.linalg.norm(leaves[part]) / jnp.linalg.norm(towards) * towards

        def moved(by, leaves=leaves, structure=structure, part=part, step=step):
            return loss(jax.tree.unflatten(structure, [*leaves[:part], leaves[part] + by * step, *leaves[part + 1 :]]))

        # Of second order; a start beyond a border of map squares still leaves a little.
        difference = (8 * (moved(0.5) - moved(-0.5)) - (moved(1.0) - moved(-1.0))) / 6
        np.testing.assert_allclose(difference, jnp.vdot(slopes, step), rtol=0.02)


def test_learns_what_greedy_training_does_not():
    cascade, errors = tuned()
    before = mean_error(fit_crops(greedy(), NEW_CROPS), NEW_LANDMARKS)
    after = mean_error(fit_crops(cascade, NEW_CROPS), NEW_LANDMARKS)
    assert after < 0.85 * before
    assert len(errors) == TUNING.epochs + 1
    assert errors[-1] < 0.85 * errors[0]


def test_the_best_epoch_is_taken(monkeypatch):
    said = iter([0.5, 0.4, 0.1, 0.3])
    monkeypatch.setattr(tuning, "_checked", lambda *_: next(said))
    states = []
    cascade, errors = finetune_cascade(greedy(), FACES, CHECK, SPREAD, replace(TUNING, epochs=3), keep=states.append)
    np.testing.assert_allclose(errors, [0.5, 0.4, 0.1, 0.3])
    assert_same_bits(states[2].best, states[1].learned)
    np.testing.assert_array_equal(cascade.weights[0], states[1].learned.weights[0].astype(jnp.float16))


def test_without_faces_to_check_the_last_epoch_is_taken():
    states = []
    _, errors = finetune_cascade(greedy(), FACES, None, SPREAD, replace(TUNING, epochs=2), keep=states.append)
    assert np.isnan(errors).all()
    assert_same_bits(states[1].best, states[1].learned)


def test_the_same_seed_gives_the_same_bits():
    again = finetune_cascade(greedy(), FACES, CHECK, SPREAD, TUNING)
    assert_same_bits(again, tuned())
    assert not np.array_equal(tuned(seed=1)[0].weights[0], again[0].weights[0])


class Killed(Exception):
    pass


def test_a_killed_run_goes_on_to_the_same_bits():
    states = []

    def keep(state):
        states.append(state)
        if len(states) == 3:
            raise Killed

    with pytest.raises(Killed):
        finetune_cascade(greedy(), FACES, CHECK, SPREAD, TUNING, keep=keep)
    resumed = finetune_cascade(greedy(), FACES, CHECK, SPREAD, TUNING, resume=lambda begun: states[-1])
    assert_same_bits(resumed, tuned())


def test_weights_are_what_a_file_of_16_bits_keeps():
    weights = np.asarray(tuned()[0].weights)
    np.testing.assert_array_equal(weights, weights.astype(np.float16))


def test_missing_landmarks_do_not_count():
    landmarks = FACES.landmarks.copy()
    landmarks[::2, 1] = np.nan
    loss = loss_of(greedy(), landmarks)
    value, gradient = jax.value_and_grad(loss)(learned_of(greedy()))
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    known = np.asarray(tuning._distances(SPACE, *_one_face(landmarks[0])))
    whole = np.asarray(tuning._distances(SPACE, *_one_face(FACES.landmarks[0])))
    np.testing.assert_array_equal(np.isnan(known), [False, True, False, False])
    np.testing.assert_array_equal(known[[0, 2, 3]], whole[[0, 2, 3]])


def _one_face(landmarks):
    state = tuning.State(jnp.asarray(FACES.landmarks[1].reshape(-1)), jnp.float32(0))
    return state, jnp.asarray(landmarks), jnp.full(4, jnp.nan)


def test_a_landmark_that_nobody_labelled_is_learned_from_the_others_steps_alone():
    landmarks = np.full_like(FACES.landmarks, np.nan)
    landmarks[:, :3] = FACES.landmarks[:, :3]
    cascade, _ = finetune_cascade(greedy(), replace(FACES, landmarks=landmarks), None, SPREAD, TUNING)
    # The last step's outputs for it serve nobody.
    np.testing.assert_array_equal(cascade.weights[-1][:, 6:], greedy().weights[-1][:, 6:])
    assert not np.array_equal(cascade.weights[-1][:, :6], greedy().weights[-1][:, :6])


@pytest.mark.parametrize(
    "wrong",
    [{"epochs": 0}, {"rate": 0.0}, {"rate": np.nan}, {"batch": 0}, {"dropped": 1.0}, {"seed": -1}],
    ids=str,
)
def test_wrong_options(wrong):
    with pytest.raises(InputError, match="expected epochs and batch >= 1"):
        Tuning(**wrong)


def test_a_single_step_learns():
    """Of one epoch and one batch, in which the rate has no time to grow."""
    once = replace(TUNING, epochs=1, batch=COUNT)
    cascade, _ = finetune_cascade(greedy(), FACES, None, SPREAD, once)
    assert not np.array_equal(cascade.weights[0], greedy().weights[0])


def test_each_face_is_seen_in_each_epoch(monkeypatch):
    seen, batch_of = [], tuning._batch_of

    def watched(faces, depths, rows, guessed):
        seen.append(rows)
        return batch_of(faces, depths, rows, guessed)

    monkeypatch.setattr(tuning, "_batch_of", watched)
    finetune_cascade(greedy(), FACES, None, SPREAD, replace(TUNING, epochs=2, batch=16))
    for epoch in np.reshape(seen, (2, 48)):
        counts = np.bincount(epoch, minlength=COUNT)
        assert (counts.min(), counts.max()) == (1, 2)


def test_faces_are_drawn_by_their_shares(monkeypatch):
    shares = np.where(np.arange(COUNT) < 10, 3.0, np.where(np.arange(COUNT) < 20, 0.0, 1.0))
    seen, batch_of = [], tuning._batch_of
    monkeypatch.setattr(tuning, "_batch_of", lambda *some: (seen.append(some[2]), batch_of(*some))[1])
    finetune_cascade(greedy(), replace(FACES, shares=shares), None, SPREAD, replace(TUNING, epochs=8, batch=COUNT))
    counts = np.bincount(np.concatenate(seen), minlength=COUNT)
    assert not counts[10:20].any()
    np.testing.assert_allclose(counts[:10].sum() / counts.sum(), 0.6, atol=0.1)


@pytest.mark.parametrize("guessed", [0.0, 0.5, 1.0])
def test_guessed_landmarks_count_as_much_as_asked(guessed):
    """One landmark alone counts; then it with another that is guessed: a mean of both."""
    first = np.arange(FACES.landmarks.shape[1]) == 0
    second = np.arange(FACES.landmarks.shape[1]) == 1

    def loss(known, of_guessed=None):
        landmarks = np.where(known[:, None], FACES.landmarks, np.nan).astype(np.float32)
        marks = None if of_guessed is None else np.tile(of_guessed, (COUNT, 1))
        faces = replace(FACES, landmarks=landmarks, guessed=marks)
        batch = tuning._batch_of(faces, tuning._depths(greedy(), faces), np.arange(8), guessed)
        batch = tuning._upright(batch)
        drawn = tuning._Drawn(SPREAD.sigmas, jnp.float32(0))
        states = tuning._starts(greedy(), random.split(random.key(0), 8), batch.pivots, drawn)
        return float(tuning._loss(greedy(), tuning._levels(greedy()), batch, states, random.key(1), 0.0))

    expected = (loss(first) + guessed * loss(second)) / (1 + guessed)
    np.testing.assert_allclose(loss(first | second, second), expected, rtol=1e-4)


def test_hidden_units_add_nothing_before_they_learn():
    begun = tuning._with_units(greedy(rank=5), replace(TUNING, units=16))
    np.testing.assert_array_equal(fit_crops(begun, NEW_CROPS), fit_crops(greedy(rank=5), NEW_CROPS))
    assert tuning._with_units(begun, replace(TUNING, units=16)) is begun
    with pytest.raises(InputError, match="expected units 0 or 16"):
        tuning._with_units(begun, replace(TUNING, units=8))
    learned, errors = finetune_cascade(greedy(rank=5), FACES, CHECK, SPREAD, replace(TUNING, units=16))
    assert np.abs(learned.hidden.output).max() > 0.01
    assert errors[-1] < 0.85 * errors[0]


def test_starts_are_turned_as_far_as_training_had_them():
    """Of a cascade that is tuned from upright starts alone, turned ones get worse."""
    options = replace(CAUTIOUS, augmentations=8)
    before = train_cascade(SPACE, Patch(turns=True), FRAME, FACES, SPREAD, options, turn=1.0)
    gentle = replace(TUNING, epochs=6)
    _, errors = finetune_cascade(before, FACES, CHECK, SPREAD, gentle, turn=1.0)
    assert errors[-1] < errors[0]
    upright, _ = finetune_cascade(before, FACES, None, SPREAD, gentle)
    _, of_upright = finetune_cascade(upright, FACES, CHECK, SPREAD, replace(gentle, epochs=1), turn=1.0)
    assert errors[-1] < 0.9 * of_upright[0]


def test_fits_that_run_away_stop_it():
    lost = replace(greedy(), biases=jnp.full_like(greedy().biases, jnp.nan))
    with pytest.raises(InputError, match="no finite gradient in epoch 1"):
        finetune_cascade(lost, FACES, None, SPREAD, TUNING)


def test_a_face_that_runs_away_takes_no_other_along():
    """Its batch is left out; what is without it is learned from."""
    pivots = FACES.pivots.copy()
    pivots[0] = np.nan
    lost, calm = replace(FACES, pivots=pivots), replace(TUNING, epochs=1, disturbance=Disturbance(*[0.0] * 6))
    cascade, _ = finetune_cascade(greedy(), lost, None, SPREAD, calm, turn=0.1)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(learned_of(cascade)))
    assert not np.array_equal(cascade.weights[0], greedy().weights[0])


def test_no_faces():
    none = training_set(np.zeros((0, 48, 48), np.uint8), np.zeros((0, 4, 2), np.float32))
    with pytest.raises(InputError, match="expected faces to learn from"):
        finetune_cascade(greedy(), none, None, SPREAD, TUNING)
