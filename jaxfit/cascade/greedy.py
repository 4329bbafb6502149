"""Training a cascade (thesis, Fig. 5): perturb, describe, regress, advance, one step after the other."""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from math import isfinite

import jax
import numpy as np
from jax import lax, random, vmap
from jax import numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from jaxfit.cascade.model import Cascade, Regressor
from jaxfit.cascade.regression import Moments, Projection, Spectrum, main_directions, solve, spectrum
from jaxfit.cascade.starts import Spread
from jaxfit.cascade.state import State, advanced, features_of, state_of, step_to, target_of
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.errors import InputError
from jaxfit.image.disturb import Disturbance, disturbed
from jaxfit.image.frame import Frame
from jaxfit.processes import by_first, gathered, total
from jaxfit.shapes.space import ShapeSpace, Start
from jaxfit.types import Crop, Landmarks, Point, Progress, Scalar, silent

# Samples that are described at once; it bounds memory, whatever the number of faces and augmentations.
_BATCH = 2048
# Samples that the principal axes are learned from; more of them cost memory and time and change the axes little.
_PCA_SAMPLES = 3072
_DISTURBED_AT_ONCE = 64  # crops
_AMOUNTS = Disturbance()  # of copies, as in fine-tuning


@dataclass(frozen=True)
class Greedy:
    """How to train a cascade, one step after the other.

    Attributes:
        windows: side of the descriptor window at each step, as a share of the face's side; one number a step. The
            thesis's constant, 32 pixels, is ``(32 / frame.face,) * steps``.
        augmentations: starts drawn for each face; a mirrored face counts as a face of its own.
        variance: share of the features' variance that the PCA keeps, in (0, 1].
        ridge: strength of the ridge penalty, relative to the mean variance of a kept component; 0 is least squares.
        rank: how many directions of its parameters each step is taken along, those in which what it predicts varies
            most; None: all. Fewer make a model smaller and faster.
        spread: factor on the measured spread of the starts. They are drawn around crops in which true faces scatter
            too, so that the starts of training are wider than those of fitting: better than narrower.
        seed: of boxes and starts; the same seed, machine and number of cores give the same bits.
        copies: of each face, whose pictures are turned, scaled, sheared, blurred, made noisy or partly hidden: worth
            their time where pictures are few. A copy counts as a face of its own.

    Raises:
        InputError: an option out of range.
    """

    windows: tuple[float, ...] = (0.45, 0.34, 0.26, 0.2, 0.15)
    augmentations: int = 5
    variance: float = 0.95
    ridge: float = 1.0
    rank: int | None = None
    spread: float = 1.0
    seed: int = 0
    copies: int = 0

    def __post_init__(self) -> None:
        if not (
            self.windows
            and all(map(isfinite, (*self.windows, self.variance, self.ridge, self.spread)))
            and min(self.windows) > 0
            and self.augmentations >= 1
            and (self.rank is None or (isinstance(self.rank, int) and self.rank >= 1))
            and 0 < self.variance <= 1
            and min(self.ridge, self.spread, self.seed, self.copies) >= 0
        ):
            raise InputError(
                "expected at least one step, windows > 0, rank and augmentations >= 1, 0 < variance <= 1, and copies, "
                f"ridge, spread and seed >= 0; got windows {self.windows}, augmentations {self.augmentations}, copies "
                f"{self.copies}, rank {self.rank}, variance {self.variance}, ridge {self.ridge}, spread {self.spread}, "
                f"seed {self.seed}"
            )


@dataclass(frozen=True)
class TrainingSet:
    """Faces to learn from.

    Attributes:
        crops: (N, H, H) uint8.
        landmarks: (N, L, 2) true landmarks, in crop pixels.
        mirrored: (N,) bool, True where the crop must be flipped left to right to agree with its landmarks, so that
            mirrored pictures share their pixels with the originals. ``source`` then names the crop.
        source: (N,) index into ``crops``.
        pivots: (N, 2) centres of the face boxes in crop pixels, about which starts are turned.
        numbers: (N,) which of the faces these are that several processes learn from; None: they are all.
        of: how many all are; None: N.
        guessed: (N, L) bool, which landmarks nobody labelled, but a head model put where they are; None: none.
        shares: (N,) how often faces are drawn in fine-tuning, relative to each other; None: all alike.
    """

    crops: UInt8[np.ndarray, "crops height width"]
    landmarks: Float[np.ndarray, "faces landmarks 2"]
    mirrored: Bool[np.ndarray, "faces"]
    source: np.ndarray
    pivots: Float[np.ndarray, "faces 2"]
    numbers: np.ndarray | None = None
    of: int | None = None
    guessed: Bool[np.ndarray, "faces landmarks"] | None = None
    shares: np.ndarray | None = None


@partial(jax.jit, static_argnames="amounts")
def _disturbed(
    keys: Array,
    crops: UInt8[Array, "faces height width"],
    mirrored: Bool[Array, "faces"],
    points: Float[Array, "faces points 2"],
    amounts: Disturbance,
) -> tuple[UInt8[Array, "faces height width"], Float[Array, "faces points 2"]]:
    def of_face(key: Array, crop: Crop, points: Landmarks) -> tuple[Crop, Landmarks]:
        other, warp = disturbed(key, crop, amounts)
        return other, warp.points(points)

    return vmap(of_face)(keys, jnp.where(mirrored[:, None, None], crops[:, :, ::-1], crops), points)


def with_copies(faces: TrainingSet, copies: int, seed: int, amounts: Disturbance = _AMOUNTS) -> TrainingSet:
    """The faces, and so many copies of each with disturbed pictures: where pictures are few, they teach what more
    pictures would. Copies of a face are the same whichever faces come with it."""
    if not copies or not len(faces.source):
        return faces
    count = len(faces.source)
    numbers = np.arange(count) if faces.numbers is None else faces.numbers
    every = faces.of or count
    crops, landmarks, pivots = [faces.crops], [faces.landmarks], [faces.pivots]
    size = min(_DISTURBED_AT_ONCE, count)
    for copy in range(1, copies + 1):
        keys = vmap(partial(random.fold_in, random.fold_in(random.key(seed), copy)))(jnp.asarray(numbers, jnp.int32))
        for first in range(0, count, size):
            rows = np.minimum(np.arange(first, first + size), count - 1)
            points = np.concatenate([faces.landmarks[rows], faces.pivots[rows][:, None]], 1)
            given = faces.crops[faces.source[rows]], faces.mirrored[rows], points.astype(np.float32)
            pictures, moved = (np.asarray(each)[: count - first] for each in _disturbed(keys[rows], *given, amounts))
            crops.append(pictures)
            landmarks.append(moved[:, :-1])
            pivots.append(moved[:, -1])
    return TrainingSet(
        crops=np.concatenate(crops),
        landmarks=np.concatenate(landmarks),
        mirrored=np.concatenate([faces.mirrored, np.zeros(copies * count, bool)]),
        source=np.concatenate([faces.source, len(faces.crops) + np.arange(copies * count)]),
        pivots=np.concatenate(pivots),
        numbers=np.concatenate([numbers + copy * every for copy in range(copies + 1)]),
        of=(copies + 1) * every,
    )


@dataclass(frozen=True)
class SharedAxes:
    """Principal axes of the features of each step, for several trainings on the same faces that differ in little: to
    find them takes half of the time of a training, and what they are depends little on where a step begins.

    Attributes:
        variance: share of the variance that the trainings keep at most.
        found: by step, the window and what was found in it last.
    """

    variance: float
    found: dict[int, tuple[float, Spectrum]] = field(default_factory=dict)

    def of(self, step: int, window: float, find: Callable[[float], Spectrum]) -> Spectrum:
        """Of a step, found by the first training that takes it in this window."""
        if self.found.get(step, (None,))[0] != window:
            self.found[step] = window, find(self.variance)
        return self.found[step][1]


def sample_starts(key: Array, count: int, frame: Frame, sigmas: Float[Array, "4"], turn: Scalar, pivot: Point) -> Start:
    """``count`` Monte Carlo starts around the middle of the crop, spread by ``Spread.sigmas``, turned about a point of
    the crop by up to ``turn`` radians, evenly in both directions."""
    shift, scale, rotation = random.split(key, 3)
    starts = Start(
        centre=frame.middle + sigmas[:2] * frame.face * random.normal(shift, (count, 2), sigmas.dtype),
        scale=jnp.exp(sigmas[2] * random.normal(scale, (count,), sigmas.dtype)),
        rotation=sigmas[3] * random.normal(rotation, (count,), sigmas.dtype),
    )
    turns = random.uniform(random.fold_in(rotation, 1), (count,), sigmas.dtype, minval=-turn, maxval=turn)
    return vmap(Start.turned, (0, None, 0))(starts, pivot, turns)


def _solved(moments: Moments, ridge: Scalar, rank: int | None) -> Regressor:
    weights, bias = solve(moments, ridge)
    if rank is None or rank >= weights.shape[1]:
        return Regressor(weights, bias, None)
    directions = main_directions(moments, weights, rank)
    weights = jnp.matmul(weights, directions.T, precision=lax.Precision.HIGHEST)
    alone = Regressor(weights, jnp.zeros_like(bias), directions)
    # Means stay what they are, however few the directions.
    return alone._replace(bias=(moments.y - alone.predict(moments.x)) / moments.count)


@partial(jax.jit, static_argnames="descriptor")
def _targets(descriptor: Descriptor, space: ShapeSpace, landmarks: Float[Array, "faces landmarks 2"]) -> State:
    return vmap(partial(target_of, descriptor, space))(landmarks)


@partial(jax.jit, static_argnames=("descriptor", "count", "frame"))
def draw_states(
    descriptor: Descriptor,
    space: ShapeSpace,
    keys: Array,
    pivots: Array,
    count: int,
    frame: Frame,
    sigmas: Float[Array, "4"],
    turn: Scalar,
) -> State:
    """States (faces, augmentations) to start from."""

    def face(key: Array, pivot: Point) -> State:
        starts = sample_starts(key, count, frame, sigmas, turn, pivot)
        return vmap(lambda start: state_of(descriptor, space, space.place(start)))(starts)

    return vmap(face)(keys, pivots)


@partial(jax.jit, static_argnames="descriptor")
def _describe(
    descriptor: Descriptor,
    space: ShapeSpace,
    crops: UInt8[Array, "faces height width"],
    mirrored: Bool[Array, "faces"],
    states: State,
    window: Scalar,
) -> Float[Array, "faces augmentations features"]:
    flipped = jnp.where(mirrored[:, None, None], crops[:, :, ::-1], crops)
    return features_of(descriptor, space, vmap(descriptor.prepare)(flipped), states, window)


@jax.jit
def _steps_to(space: ShapeSpace, targets: State, states: State) -> Float[Array, "faces augmentations params"]:
    return vmap(lambda target, states: vmap(lambda state: step_to(space, target, state))(states))(targets, states)


@partial(jax.jit, donate_argnames="moments")
def _observe(
    projection: Projection,
    moments: Moments,
    features: Float[Array, "faces augmentations features"],
    steps: Float[Array, "faces augmentations params"],
    valid: Bool[Array, "faces"],
) -> tuple[Moments, Float[Array, "faces augmentations kept"]]:
    """The moments with a batch added, and the batch's principal components."""
    reduced = jnp.matmul(features - projection.mean, projection.axes, precision=lax.Precision.HIGHEST)
    weights = jnp.repeat(valid.astype(jnp.float32), reduced.shape[1])
    moments = moments.add(reduced.reshape(-1, reduced.shape[-1]), steps.reshape(-1, steps.shape[-1]), weights)
    return moments, reduced


@partial(jax.jit, static_argnames="descriptor")
def _advance(
    descriptor: Descriptor,
    space: ShapeSpace,
    states: State,
    steps: Float[Array, "faces augmentations params"],
) -> State:
    return vmap(vmap(partial(advanced, descriptor, space)))(states, steps)


@jax.jit
def _unfolded(projection: Projection, regressor: Regressor) -> Regressor:
    """A regressor of principal components as one of the raw features, rounded to what model files store, so that saving
    changes nothing."""
    weights = jnp.matmul(projection.axes, regressor.weights, precision=lax.Precision.HIGHEST)
    weights = weights.astype(jnp.float16).astype(jnp.float32)
    mean = regressor._replace(weights=weights, bias=jnp.zeros_like(regressor.bias)).predict(projection.mean)
    return Regressor(weights, regressor.bias - mean, regressor.directions)


def train_cascade(
    space: ShapeSpace,
    descriptor: Descriptor,
    frame: Frame,
    faces: TrainingSet,
    spread: Spread,
    greedy: Greedy,
    *,
    turn: float = 0.0,
    axes: SharedAxes | None = None,
    progress: Progress = silent,
) -> Cascade:
    """Learn one regressor a step, each on the states that the previous steps produced (thesis, Fig. 5).

    Features are described batch by batch and only the moments of their principal components are kept in memory; beside
    the crops, a sample costs the memory of its state alone, and some kilobytes of temporary disk during a step. The
    principal axes come from a fixed number of samples.

    Several processes each describe and move their own faces. What they learn from is that of all: samples for the
    principal axes are gathered and moments summed, and the first process makes a regressor of them.

    Args:
        space: shape space to regress in.
        descriptor: what is seen at a landmark.
        frame: size of the crops.
        faces: what to learn from.
        spread: of the Monte Carlo starts, before the factor ``greedy.spread``.
        greedy: how.
        turn: by how many radians more, at most, the starts are turned, evenly in both directions.
        axes: principal axes that are shared with other trainings; None finds them anew.
        progress: called with the stage's name, what is done and what there is to do.

    Raises:
        InputError: no faces.
    """
    if len(faces.source) == 0:
        raise InputError("expected at least one face to learn from; got none")
    windows, augmentations, spread = greedy.windows, greedy.augmentations, spread.scaled(greedy.spread)
    count = len(faces.source)
    every = faces.of or count
    numbers = np.arange(count) if faces.numbers is None else faces.numbers
    size = max(1, min(_BATCH // augmentations, count))
    rounds = -(-count // size)
    keys = random.split(random.key(greedy.seed), every + 1)
    targets = _targets(descriptor, space, jnp.asarray(faces.landmarks, jnp.float32))
    states = np.empty((count, augmentations, space.size), np.float32)
    angles = np.empty((count, augmentations), np.float32)
    regressors = []

    def batches(stage: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Face numbers, and which of them do not merely fill the last batch."""
        for done in range(rounds):
            progress(stage, done, rounds)
            rows = np.arange(done * size, (done + 1) * size)
            valid, rows = rows < count, np.minimum(rows, count - 1)
            yield rows, valid
        progress(stage, rounds, rounds)

    def taken(rows: np.ndarray) -> State:
        return State(jnp.asarray(states[rows]), jnp.asarray(angles[rows]))

    def put(rows: np.ndarray, new: State) -> None:
        states[rows], angles[rows] = new.params, new.angle

    def described(rows: np.ndarray, window: Scalar) -> Float[Array, "faces augmentations features"]:
        # Compiled once, apart from what depends on how many components the step's PCA keeps.
        crops, flips = jnp.asarray(faces.crops[faces.source[rows]]), jnp.asarray(faces.mirrored[rows])
        return _describe(descriptor, space, crops, flips, taken(rows), window)

    def principal(stage: str, window: Scalar, variance: float) -> Spectrum:
        """Principal axes of the features of samples spread evenly over a random order of the faces."""
        each = min(augmentations, max(1, _PCA_SAMPLES // every))
        chosen = np.asarray(random.permutation(keys[every], every))[: _PCA_SAMPLES // each]
        own = np.full(every, -1)
        own[numbers] = np.arange(count)
        places = np.flatnonzero(own[chosen] >= 0)  # of this process's faces among the chosen
        here = own[chosen[places]]
        parts = []
        for first in range(0, max(1, len(here)), size):  # once without any: others must know the features' number
            progress(stage, first, len(here))
            batch = described(np.resize(here[first : first + size], size), window)
            parts.append(np.asarray(batch[: len(here) - first, :each]))
        samples = gathered(np.concatenate(parts), places, len(chosen))
        mean, directions, held = by_first(
            lambda: spectrum(jnp.asarray(samples.reshape(-1, samples.shape[-1])), variance)
        )
        return Spectrum(Projection(mean, directions), held)

    for rows, _ in batches("drawing starts"):
        pivots = jnp.asarray(faces.pivots[rows], jnp.float32)
        put(
            rows,
            draw_states(
                descriptor, space, keys[numbers[rows]], pivots, augmentations, frame, spread.sigmas, jnp.float32(turn)
            ),
        )
    for number, share in enumerate(windows, 1):
        step = f"step {number}/{len(windows)}"
        window = jnp.float32(share * frame.face)
        find = partial(principal, f"{step}: PCA", window)
        projection = axes.of(number, share, find).keeping(greedy.variance) if axes else find(greedy.variance).projection
        moments = Moments.empty(projection.axes.shape[1], space.size)
        # Principal components wait on disk for the regressor: describing everything again takes much longer.
        with tempfile.TemporaryFile() as components:
            for rows, valid in batches(f"{step}: features"):
                steps = _steps_to(space, State(targets.params[rows], targets.angle[rows]), taken(rows))
                features = described(rows, window)
                moments, reduced = _observe(projection, moments, features, steps, jnp.asarray(valid))
                components.write(np.asarray(reduced).tobytes())
            regressor = Regressor(*by_first(partial(_solved, total(moments), jnp.float32(greedy.ridge), greedy.rank)))
            regressors.append(jax.tree.map(np.asarray, _unfolded(projection, regressor)))
            components.seek(0)
            for rows, _ in batches(f"{step}: advancing") if number < len(windows) else ():
                reduced = np.frombuffer(components.read(reduced.nbytes), np.float32).reshape(reduced.shape)
                put(rows, _advance(descriptor, space, taken(rows), regressor.predict(jnp.asarray(reduced))))
    directions = [each.directions for each in regressors if each.directions is not None]
    return Cascade(
        space=space,
        weights=tuple(jnp.asarray(each.weights) for each in regressors),
        biases=jnp.asarray(np.stack([each.bias for each in regressors])),
        windows=jnp.asarray(windows, jnp.float32) * frame.face,
        descriptor=descriptor,
        frame=frame,
        directions=jnp.asarray(np.stack(directions)) if directions else None,
    )
