"""Fine-tuning a cascade: all of its steps together, by stochastic gradients of the error that they leave in the end.

Training one step after the other is greedy: each step is the best for itself, whatever it leaves to the later ones. The
whole cascade is differentiable, so that all regressors can learn what serves the last step.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from math import isfinite
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from jax import lax, random, vmap
from jax import numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from jaxfit.cascade.greedy import TrainingSet, draw_states
from jaxfit.cascade.model import Cascade, Hidden
from jaxfit.cascade.starts import Spread
from jaxfit.cascade.state import State, advanced, landmarks_of
from jaxfit.errors import InputError
from jaxfit.image.disturb import Disturbance, disturbed
from jaxfit.modes import mixing_types
from jaxfit.shapes.space import ShapeSpace3D
from jaxfit.types import Crop, Features, Landmarks, Point, Progress, Scalar, silent

# Of the canonical face's side: below it the loss grows with the square of the error, above it with the error.
_BEND = 0.02
# What a step's error counts, as a share of the next one's.
_EARLIER = 0.6
_WARM_UP = 0.05  # of the steps of the optimiser, in which its rate grows to the full one
_BEGIN = 0.1  # of the full rate, at the very first
_CLIP = 1.0  # norm of the gradient
_CHECKED_AT_ONCE = 256


@dataclass(frozen=True)
class Tuning:
    """How to fine-tune.

    Attributes:
        epochs: how often each face is seen, each time from another start and in another disturbance. A few are seen
            once more, to fill an epoch's last batch.
        rate: of learning (Adam), at its highest, relative to the size of what is tuned; it falls to nothing along half
            a cosine.
        batch: faces a step of the optimiser.
        dropped: share of the landmarks that a step does not see, so that it does not rely on few.
        spread: factor on the spread of the starts.
        units: hidden units that each step gets, if the cascade has none: see `jaxfit.cascade.model.Hidden`.
        guessed: what a landmark counts that a 3D head model guessed, relative to one that is labelled; with 0 those are
            unknown.
        balance: how evenly faces are drawn over their yaws: with 0 each as often as every other, with 1 each band of 15
            degrees as often as every other.
        disturbance: of the pictures.
        seed: of all that is random; the same seed, machine and number of cores give the same bits.

    Raises:
        InputError: an option out of range.
    """

    epochs: int = 20
    rate: float = 0.05
    batch: int = 64
    dropped: float = 0.3
    spread: float = 1.0
    units: int = 0
    guessed: float = 0.0
    balance: float = 0.0
    disturbance: Disturbance = field(default_factory=Disturbance)
    seed: int = 0

    def __post_init__(self) -> None:
        possible = all(map(isfinite, (self.rate, self.dropped, self.spread, self.guessed, self.balance)))
        possible = possible and min(self.dropped, self.spread, self.units, self.guessed, self.balance, self.seed) >= 0
        possible = possible and self.dropped < 1 and max(self.guessed, self.balance) <= 1
        if not (possible and self.rate > 0 and min(self.epochs, self.batch) >= 1):
            raise InputError(
                "expected epochs and batch >= 1, rate > 0, 0 <= dropped < 1, guessed and balance from 0 to 1, and "
                f"spread, units and seed >= 0; got epochs {self.epochs}, batch {self.batch}, rate {self.rate}, dropped "
                f"{self.dropped}, guessed {self.guessed}, balance {self.balance}, spread {self.spread}, units "
                f"{self.units}, seed {self.seed}"
            )


class Learned(NamedTuple):
    """What is tuned of a cascade; see `Cascade` for shapes."""

    weights: tuple[Array, ...]
    biases: Array
    directions: Array | None
    hidden: Hidden | None = None


class Progressed(NamedTuple):
    """How far fine-tuning has come: all that it needs to go on.

    Attributes:
        learned: as it is now.
        optimiser: the optimiser's state.
        best: as it was when the error on the faces to check was smallest.
        errors: those errors, one an epoch, the first before any.
    """

    learned: Learned
    optimiser: Any
    best: Learned
    errors: Float[Array, "epochs"]


def finetune_cascade(
    cascade: Cascade,
    faces: TrainingSet,
    check: TrainingSet | None,
    spread: Spread,
    tuning: Tuning,
    *,
    turn: float = 0.0,
    progress: Progress = silent,
    keep: Callable[[Progressed], None] = lambda progressed: None,
    resume: Callable[[Progressed], Progressed] = lambda begun: begun,
) -> tuple[Cascade, Float[Array, "epochs"]]:
    """Tune all regressors of a cascade together.

    The loss is smooth L1 of the distances of landmarks from the true ones, in sides of the canonical face, after each
    step, the later ones counting more; in 3D, of the distances in space, which pose and depth are part of.

    Args:
        cascade: a trained cascade.
        faces: what to learn from; landmarks that are NaN do not count.
        check: faces of other people, by whose errors the best epoch is chosen; None: the last is.
        spread: of the Monte Carlo starts.
        tuning: how.
        turn: by how much starts are turned about the face, at most, in radians.
        progress: called with the stage's name, what is done and what there is to do.
        keep: called after each epoch with all that is needed to go on from there.
        resume: is given what fine-tuning would begin with, and returns what it shall, as ``keep`` was given it.

    Returns:
        The cascade, and the mean distance of the landmarks from the true ones on the faces to check, in sides of the
        canonical face, before and after each epoch; NaN if there are none.

    Raises:
        InputError: no faces, or no finite gradient in a whole epoch: fits run away.
    """
    count = len(faces.source)
    if count == 0:
        raise InputError("expected faces to learn from; got none")
    batches = -(-count // tuning.batch)
    rates = _rates(tuning, batches)
    cascade = _with_units(cascade, tuning)
    learned = Learned(cascade.weights, cascade.biases, cascade.directions, cascade.hidden)
    depths = _depths(cascade, faces)
    drawn = _Drawn(spread.sigmas * tuning.spread, jnp.float32(turn))
    of_checked = None if check is None else _depths(cascade, check)
    checked = partial(_checked, cascade, check, of_checked, drawn._replace(sigmas=spread.sigmas), tuning)
    state = resume(Progressed(learned, _OPTIMISER.init(learned), learned, jnp.asarray([checked(learned)], jnp.float32)))
    done = len(state.errors) - 1
    for epoch in range(done, tuning.epochs):
        # Both are overwritten in place.
        learned, of_optimiser = jax.tree.map(jnp.copy, (state.learned, state.optimiser))
        of_epoch = random.fold_in(random.key(tuning.seed), epoch)
        order = _drawn_rows(of_epoch, faces, batches * tuning.batch)
        for number in range(batches):
            progress("fine-tuning", epoch * batches + number, tuning.epochs * batches)
            rows = order[number * tuning.batch : (number + 1) * tuning.batch]
            learned, of_optimiser = _updated(
                cascade,
                learned,
                of_optimiser,
                _batch_of(faces, depths, rows, tuning.guessed),
                random.fold_in(of_epoch, number),
                drawn,
                rates[epoch * batches + number],
                _levels(cascade),
                tuning.dropped,
                tuning.disturbance,
            )
        if of_optimiser.notfinite_count >= batches:
            raise InputError(
                f"fine-tuning ran away, with no finite gradient in epoch {epoch + 1}; expected a rate below "
                f"{tuning.rate}, a smaller spread, or a cascade that is trained better"
            )
        error = checked(learned)
        best = learned if check is None or error <= jnp.nanmin(state.errors) else state.best
        state = Progressed(learned, of_optimiser, best, jnp.append(state.errors, jnp.float32(error)))
        keep(state)
    progress("fine-tuning", tuning.epochs * batches, tuning.epochs * batches)
    return _rounded(cascade, state.best), state.errors


class _Drawn(NamedTuple):
    """How starts are drawn: their standard deviations, and by how much they are turned at most, in radians."""

    sigmas: Float[Array, "4"]
    turn: Scalar


def _drawn_rows(key: Array, faces: TrainingSet, count: int) -> np.ndarray:
    """(count,) which faces an epoch shows: each once, the last ones again; or by their shares."""
    if faces.shares is None:
        return np.resize(np.asarray(random.permutation(key, len(faces.source))), count)
    shares = jnp.asarray(faces.shares / faces.shares.sum(), jnp.float32)
    return np.asarray(random.choice(key, len(faces.source), (count,), p=shares))


def _with_units(cascade: Cascade, tuning: Tuning) -> Cascade:
    """The cascade with hidden units that add nothing yet.

    Raises:
        InputError: it has others already.
    """
    if not tuning.units:
        return cascade
    if cascade.hidden is not None:
        if (count := cascade.hidden.biases.shape[1]) != tuning.units:
            raise InputError(f"expected units 0 or {count}, which the cascade has already; got {tuning.units}")
        return cascade
    steps, outputs, params = len(cascade.weights), cascade.weights[0].shape[1], cascade.biases.shape[1]
    of_weights, of_biases = random.split(random.key(tuning.seed))
    drawn = random.normal(of_weights, (steps, outputs, tuning.units), jnp.float32)
    hidden = Hidden(
        drawn / (np.sqrt(outputs).astype(np.float32) * _found_sizes(cascade)[:, :, None]),
        random.uniform(of_biases, (steps, tuning.units), jnp.float32, -1.0, 1.0),
        jnp.zeros((steps, tuning.units, params), jnp.float32),
    )
    return replace(cascade, hidden=hidden)


class _Batch(NamedTuple):
    """Faces of a `TrainingSet`: their own crops, the depths (faces, landmarks) of 3D landmarks, NaN in 2D, and what
    each landmark counts."""

    crops: UInt8[Array, "faces height width"]
    mirrored: Bool[Array, "faces"]
    landmarks: Float[Array, "faces landmarks 2"]
    pivots: Float[Array, "faces 2"]
    depths: Float[Array, "faces landmarks"]
    counts: Float[Array, "faces landmarks"]


def _batch_of(faces: TrainingSet, depths: np.ndarray, rows: np.ndarray, guessed: float = 0.0) -> _Batch:
    counts = np.ones(depths[rows].shape, np.float32)
    if faces.guessed is not None:
        counts[faces.guessed[rows]] = guessed
    return _Batch(
        jnp.asarray(faces.crops[faces.source[rows]]),
        jnp.asarray(faces.mirrored[rows]),
        jnp.asarray(faces.landmarks[rows], jnp.float32),
        jnp.asarray(faces.pivots[rows], jnp.float32),
        jnp.asarray(depths[rows]),
        jnp.asarray(counts),
    )


# A fit that runs away would take everything along: such a batch is left out, however many there are.
_OPTIMISER = optax.apply_if_finite(
    optax.chain(optax.clip_by_global_norm(_CLIP), optax.scale_by_adam()), np.iinfo(np.int32).max
)


def _rates(tuning: Tuning, batches: int) -> np.ndarray:
    """The rate of learning at each step of the optimiser."""
    steps = tuning.epochs * batches
    warm_up = max(1, round(_WARM_UP * steps))
    with mixing_types():
        schedule = optax.warmup_cosine_decay_schedule(_BEGIN * tuning.rate, tuning.rate, warm_up, max(2, steps))
        return np.asarray(schedule(np.arange(steps)), np.float32)


def _sizes(cascade: Cascade) -> Learned:
    """How large what is tuned is at first, by columns, as parameters, such as pixels and radians, differ in size."""
    directions, hidden = cascade.directions, cascade.hidden
    columns = [
        weights if directions is None else jnp.matmul(weights, directions[step])
        for step, weights in enumerate(cascade.weights)
    ]
    of_steps = _comes_to(cascade) * jnp.concatenate([_size(each, 0) for each in columns])
    of_hidden = None
    if hidden is not None:
        outputs, units = hidden.weights.shape[1:]
        of_hidden = Hidden(
            1 / (np.sqrt(outputs).astype(np.float32) * _found_sizes(cascade)[:, :, None]),
            jnp.ones_like(hidden.biases),
            of_steps[:, None] / np.sqrt(units).astype(np.float32),
        )
    return Learned(
        tuple(_size(weights, 0) for weights in cascade.weights),
        of_steps,
        None if directions is None else _size(directions, 1),
        of_hidden,
    )


def _size(values: Array, axis: int) -> Array:
    return jnp.sqrt(jnp.mean(values**2, axis, keepdims=True))


def _comes_to(cascade: Cascade) -> np.float32:
    """What a linear map's output comes to, times the size of its weights, as a landmark's features have length 1."""
    return np.sqrt(cascade.weights[0].shape[0] // cascade.descriptor.size).astype(np.float32)


def _found_sizes(cascade: Cascade) -> Float[Array, "steps outputs"]:
    """How large what the linear maps find is, above 0."""
    return _comes_to(cascade) * jnp.concatenate([_size(each, 0) for each in cascade.weights]) + 1e-6


def _loss(
    cascade: Cascade, levels: tuple[int, ...], batch: _Batch, states: State, key: Array, dropped: float
) -> Scalar:
    """The mean loss of a batch, with some landmarks hidden from each step."""
    keys = random.split(key, len(cascade.weights))
    keep = partial(_without_some, keys, dropped, len(batch.landmarks[0])) if dropped else _everything
    distances = _distances_of_steps(cascade, levels, batch, states, keep)
    shares = _EARLIER ** np.arange(len(distances), dtype=np.float32)[::-1]
    losses = [_mean_known(optax.losses.huber_loss(each, delta=_BEND), batch.counts) for each in distances]
    return jnp.sum(shares * jnp.stack(losses)) / _BEND


def _everything(step: int, features: Array) -> Array:
    return features


def _without_some(keys: Array, dropped: float, landmarks: int, step: int, features: Array) -> Array:
    """The features of a step, 0 for landmarks that are hidden from it, and the others so much larger."""
    of_landmarks = features.reshape(*features.shape[:2], landmarks, -1)
    kept = random.bernoulli(keys[step], jnp.float32(1 - dropped), (*of_landmarks.shape[:3], 1))
    return (jnp.where(kept, of_landmarks, 0.0) / (1 - dropped)).reshape(features.shape)


def _features(
    cascade: Cascade, prepared: Any, states: State, step: int, level: int
) -> Float[Array, "faces starts features"]:
    """What `features_of` gives, of one start a face, for gradients."""
    descriptor, space = cascade.descriptor, cascade.space

    # Looking again is several times faster than keeping what all faces' landmarks have seen.
    @jax.checkpoint
    def of_face(face: tuple[Any, State]) -> Float[Array, "landmarks features"]:
        prepared, state = face
        side = cascade.windows[step] * space.scale(state.params)

        def of_point(point: Point) -> Features:
            aim = descriptor.aim(prepared, level, point, side, state.angle)
            return descriptor.normalise(descriptor.describe(prepared, level, aim, state.angle))

        return vmap(of_point)(landmarks_of(space, state))

    found = lax.map(of_face, (prepared, jax.tree.map(lambda part: part[:, 0], states)))
    return found.reshape(len(found), 1, -1)


def _distances_of_steps(
    cascade: Cascade, levels: tuple[int, ...], batch: _Batch, states: State, keep: Callable[[int, Array], Array]
) -> list[Float[Array, "faces landmarks"]]:
    """After each step, how far the landmarks are from the true ones, in sides of the canonical face; NaN if unknown.

    ``levels`` are the descriptor's, one a step, ``states`` (faces, 1) the starts; ``keep`` gives what a step has of its
    features.
    """
    descriptor, space = cascade.descriptor, cascade.space
    prepared = vmap(descriptor.prepare)(batch.crops)
    found = []
    # Not a scan over the steps: in each, the gradient would be that of all steps' weights.
    for step in range(len(cascade.weights)):
        features = keep(step, _features(cascade, prepared, states, step, levels[step]))
        states = vmap(vmap(partial(advanced, descriptor, space)))(states, cascade.regressor(step).predict(features))
        each = jax.tree.map(lambda part: part[:, 0], states)
        found.append(vmap(partial(_distances, space))(each, batch.landmarks, batch.depths) / cascade.frame.face)
    return found


def _distances(space: Any, state: State, landmarks: Landmarks, depths: Float[Array, "landmarks"]) -> Array:
    """Of one face's landmarks from the true ones, in pixels; in space if depths are known; NaN if unknown."""
    known = jnp.isfinite(landmarks).all(1)
    apart = landmarks_of(space, state) - jnp.where(known[:, None], landmarks, 0.0)
    squares = jnp.sum(apart**2, 1)
    if isinstance(space, ShapeSpace3D):
        behind = space.landmarks_3d(state.params)[:, 2] - depths
        squares = squares + jnp.where(jnp.isfinite(depths), behind, 0.0) ** 2
    # Not at the root's vertex, where it has no derivative.
    return jnp.where(known, jnp.sqrt(squares + 1e-6), jnp.nan)


def _mean_known(values: Float[Array, "faces landmarks"], counts: Float[Array, "faces landmarks"]) -> Scalar:
    known = jnp.isfinite(values)
    counts = jnp.where(known, counts, 0.0)
    return jnp.sum(counts * jnp.where(known, values, 0.0)) / jnp.maximum(counts.sum(), 1)


@partial(jax.jit, static_argnames=("levels", "dropped", "disturbance"), donate_argnames=("learned", "of_optimiser"))
def _updated(
    cascade: Cascade,
    learned: Learned,
    of_optimiser: Any,
    batch: _Batch,
    key: Array,
    drawn: _Drawn,
    rate: Scalar,
    levels: tuple[int, ...],
    dropped: float,
    disturbance: Disturbance,
) -> tuple[Learned, Any]:
    """What is learned, and the optimiser's state, after one batch."""
    of_pictures, of_starts, of_landmarks = random.split(key, 3)
    batch = _disturbed(of_pictures, _upright(batch), disturbance)
    states = _starts(cascade, random.split(of_starts, len(batch.crops)), batch.pivots, drawn)

    def loss(learned: Learned) -> Scalar:
        return _loss(_with(cascade, learned), levels, batch, states, of_landmarks, dropped)

    slopes = jax.grad(loss)(learned)
    with mixing_types():
        changes, of_optimiser = _OPTIMISER.update(slopes, of_optimiser)
    changes = jax.tree.map(lambda change, size: -rate * change * size, changes, _sizes(cascade))
    return optax.apply_updates(learned, changes), of_optimiser


def _with(cascade: Cascade, learned: Learned) -> Cascade:
    return replace(cascade, **learned._asdict())


def _levels(cascade: Cascade) -> tuple[int, ...]:
    """At which of its resolutions the descriptor looks at each step."""
    return tuple(int(cascade.descriptor.level(window)) for window in cascade.windows)


def _upright(batch: _Batch) -> _Batch:
    """With the crops of mirrored faces flipped."""
    flipped = jnp.where(batch.mirrored[:, None, None], batch.crops[:, :, ::-1], batch.crops)
    return batch._replace(crops=flipped)


def _disturbed(key: Array, batch: _Batch, amounts: Disturbance) -> _Batch:
    def of_face(key: Array, face: _Batch, other: Crop) -> _Batch:
        crop, warp = disturbed(key, face.crops, amounts, other)
        scale = jnp.sqrt(jnp.linalg.det(warp.matrix))
        return face._replace(
            crops=crop,
            landmarks=warp.points(face.landmarks),
            pivots=warp.points(face.pivots),
            depths=face.depths / scale,
        )

    return vmap(of_face)(random.split(key, len(batch.crops)), batch, jnp.roll(batch.crops, 1, 0))


def _starts(cascade: Cascade, keys: Array, pivots: Array, drawn: _Drawn) -> State:
    return draw_states(cascade.descriptor, cascade.space, keys, pivots, 1, cascade.frame, *drawn)


@partial(jax.jit, static_argnames="levels")
def _errors(
    cascade: Cascade, batch: _Batch, key: Array, drawn: _Drawn, levels: tuple[int, ...]
) -> Float[Array, "faces"]:
    """The mean distance of each face's known landmarks from the true ones after the last step."""
    batch = _upright(batch)
    states = _starts(cascade, random.split(key, len(batch.crops)), batch.pivots, drawn)
    return jnp.nanmean(_distances_of_steps(cascade, levels, batch, states, _everything)[-1], 1)


def _checked(
    cascade: Cascade,
    faces: TrainingSet | None,
    depths: np.ndarray | None,
    drawn: _Drawn,
    tuning: Tuning,
    learned: Learned,
) -> float:
    """The mean error on faces, each from a start of its own, the same in each epoch; NaN if there are none."""
    if faces is None or depths is None:
        return float("nan")
    count, errors = len(faces.source), []
    size = min(_CHECKED_AT_ONCE, count)
    for first in range(0, count, size):
        rows = np.resize(np.arange(first, min(first + size, count)), size)
        key = random.fold_in(random.key(tuning.seed), first)
        batch = _batch_of(faces, depths, rows)
        found = _errors(_with(cascade, learned), batch, key, drawn, _levels(cascade))
        errors.append(np.asarray(found)[: count - first])
    # A fit that is lost counts as a face's side: how far it went tells nothing.
    return float(np.mean(np.minimum(np.nan_to_num(np.concatenate(errors), nan=1.0), 1.0)))


@partial(jax.jit, static_argnames="batch_size")
def _depths_of(space: ShapeSpace3D, landmarks: Float[Array, "faces landmarks 2"], batch_size: int) -> Array:
    return lax.map(lambda face: space.landmarks_3d(space.encode(face))[:, 2], landmarks, batch_size=batch_size)


def _depths(cascade: Cascade, faces: TrainingSet) -> np.ndarray:
    """The depths (N, L) of the landmarks, in crop pixels, as the 3D shape model has them that is aligned to all of a
    face's; NaN in 2D, and for faces of which not all are known."""
    if not isinstance(cascade.space, ShapeSpace3D):
        return np.full(faces.landmarks.shape[:2], np.nan, np.float32)
    return np.asarray(_depths_of(cascade.space, jnp.asarray(faces.landmarks, jnp.float32), 64))


def _rounded(cascade: Cascade, learned: Learned) -> Cascade:
    """The cascade with what was learned, rounded to what model files store, so that saving changes nothing."""
    weights = tuple(each.astype(jnp.float16).astype(jnp.float32) for each in learned.weights)
    return _with(cascade, learned._replace(weights=weights))
