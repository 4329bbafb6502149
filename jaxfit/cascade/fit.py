"""Running a cascade: one face from one start; then a batch of crops, each from one or several starts."""

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import lax, vmap
from jax import numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxfit.cascade.confidence import Clues, Confidence, moves_of
from jaxfit.cascade.model import Cascade, Hidden, Regressor
from jaxfit.cascade.starts import Starts, square_around, starts_of
from jaxfit.cascade.state import State, advanced, features_of, landmarks_of, state_of
from jaxfit.errors import InputError
from jaxfit.modes import computing
from jaxfit.shapes.asm import Coefficients
from jaxfit.shapes.space import ShapeSpace3D, Start
from jaxfit.types import Crop, Landmarks, Landmarks3D, Params, Scalar

# Few, as they wait for each other; several, as a single one does not fill the processor's vectors.
_ALIGNED_AT_ONCE = 4
_FAR = 1e4  # pixels, many crops
_Given = UInt8[Array, "faces height width"] | UInt8[np.ndarray, "faces height width"]


class Descent(NamedTuple):
    """How a cascade went in a batch of crops.

    Attributes:
        first: states (faces, starts) that it began with.
        last: those after the last step.
        each: those after each step, in a leading axis: what cascades of fewer steps would end with.
        features: what the last step looked at; that costs nothing where nobody wants to know.
    """

    first: State
    last: State
    each: State
    features: Float[Array, "faces starts features"]


def descend(cascade: Cascade, prepared: Any, states: State) -> Descent:
    """The whole cascade, from states (faces, starts) in crops (faces) that the descriptor has prepared."""
    descriptor, space = cascade.descriptor, cascade.space
    move = vmap(vmap(partial(advanced, descriptor, space)))

    def step(
        carried: tuple[State, Array], part: tuple[Array, Array, Array | None, Hidden | None, Scalar]
    ) -> tuple[tuple[State, Array], State]:
        states, _ = carried
        number, bias, directions, hidden, window = part
        features = features_of(descriptor, space, prepared, states, window)
        regressors = [Regressor(weights, bias, directions, hidden) for weights in cascade.weights]
        # All faces and starts at once, so that the weights, megabytes, are read once.
        states = move(states, lax.switch(number, [regressor.predict for regressor in regressors], features))
        return (states, features), states

    numbers = jnp.arange(len(cascade.weights), dtype=jnp.int32)
    unseen = jnp.zeros((*states.angle.shape, cascade.weights[0].shape[0]), jnp.float32)
    (last, features), each = lax.scan(
        step,
        (states, unseen),
        (numbers, cascade.biases, cascade.directions, cascade.hidden, cascade.windows),
    )
    return Descent(states, last, each, features)


def fit_face(cascade: Cascade, crop: Crop, params: Params) -> Params:
    """Fit one face from one start: parameters in, parameters out, both in the crop.

    Where windows turn with the face, so does the frame of the fit (see `State`), and what comes out are the parameters
    in the crop that come nearest to it: for spaces that do not have every turned face (see
    `ShapeSpace.closed_under_rotation`) the landmarks of `fit_crops` are the more exact ones.

    A plain function to ``jit``, ``vmap`` and ``grad`` as you like. Differentiable in everything but the hard
    orientation bins of its descriptors.
    """
    descriptor, space = cascade.descriptor, cascade.space
    alone = partial(jax.tree.map, lambda part: part[None])
    state = alone(alone(state_of(descriptor, space, params)))
    fitted = jax.tree.map(lambda part: part[0, 0], descend(cascade, alone(descriptor.prepare(crop)), state).last)
    if not descriptor.turns:
        return fitted.params
    if space.closed_under_rotation:
        return space.turned(fitted.params, fitted.angle)
    return space.encode(landmarks_of(space, fitted))


def centroid(candidates: Float[Array, "starts landmarks 2"]) -> Int[Array, ""]:
    """Index of the candidate with the smallest sum of point distances to the others (thesis 3.2.3, Eq. 12).

    Candidates that diverged, with coordinates that are not finite, are neither kept nor counted. Distances count as
    ``_FAR`` at most, so that one fit that runs away does not drown the others in rounding.
    """
    finite = jnp.isfinite(candidates).all((1, 2))
    known = jnp.where(finite[:, None, None], candidates, 0.0)
    apart = jnp.sqrt(jnp.sum((known[:, None] - known[None, :]) ** 2, -1))
    distances = jnp.minimum(apart, _FAR).sum(2)
    sums = jnp.sum(jnp.where(finite, distances, 0.0), 1)
    return jnp.argmin(jnp.where(finite, sums, jnp.inf))


@computing
def fit_crops(
    cascade: Cascade,
    crops: _Given,
    starts: Starts = Starts(),
    passes: int = 1,
) -> Float[Array, "faces landmarks 2"]:
    """Landmarks of a batch of crops, in crop pixels: the whole cascade in one compiled function.

    Args:
        cascade: a trained cascade; `first_steps` gives one of fewer steps.
        crops: uint8 grey crops of ``cascade.frame``, the expected face upright in the middle at the canonical size,
            as ``jaxfit.crop_faces`` cuts them.
        starts: how many starts each face has; of several fits the centroid is kept.
        passes: how often the cascade is run, each time from the mean face where the pass before found one.

    Raises:
        InputError: crops of another size or type, or no passes.
        ProcessError: this process was forked from one that has computed.
    """
    _require_crops(cascade, crops, passes)
    return _fit_crops(cascade, crops, starts, passes)


@partial(jax.jit, static_argnames="passes")
def _fit_crops(cascade: Cascade, crops: Array, starts: Starts, passes: int) -> Float[Array, "faces landmarks 2"]:
    return _landmarks(cascade, _best(cascade, _descended(cascade, crops, starts.rotations, passes).last))


def space_3d_of(cascade: Cascade, aligned: ShapeSpace3D | None) -> ShapeSpace3D | None:
    """The shape space of the 3D results of a cascade and of what is aligned to its landmarks; None: there are none."""
    if aligned is not None:
        return aligned
    return cascade.space if isinstance(cascade.space, ShapeSpace3D) else None


def find(
    cascade: Cascade,
    aligned: ShapeSpace3D | None,
    crops: UInt8[Array, "faces height width"],
    rotations: Float[Array, "starts"],
    passes: int = 1,
    confidence: Confidence | None = None,
) -> dict[str, Array]:
    """All that a model finds in a batch of crops, by its name in `Heads`: the landmarks alone where nothing is 3D.

    ``rotations`` are those of `Starts`, in radians. With a ``confidence`` the result has that, too, (faces,).
    """
    descent = _descended(cascade, crops, rotations, passes)
    best = _best(cascade, descent.last)
    if space_3d_of(cascade, aligned) is None:
        found = {"landmarks": _landmarks(cascade, best)}
    else:
        found = _heads(cascade, aligned, best)._asdict()
    if confidence is not None:
        found["confidence"] = vmap(confidence)(_clues(cascade, descent))
    return found


@partial(jax.jit, static_argnames="passes")
def find_clues(
    cascade: Cascade,
    crops: UInt8[Array, "faces height width"],
    rotations: Float[Array, "starts"],
    passes: int = 1,
) -> tuple[Float[Array, "faces landmarks 2"], Clues]:
    """What a model's confidence learns from: the landmarks that `find` gives, with the same arguments, and the clues of
    these fits."""
    descent = _descended(cascade, crops, rotations, passes)
    return _landmarks(cascade, _best(cascade, descent.last)), _clues(cascade, descent)


class Heads(NamedTuple):
    """Faces in 3D, in pixels; a leading axis of faces.

    Attributes:
        landmarks: (L, 2) where the landmarks were found.
        landmarks_3d: (L, 3) the 3D shape model there: x, y and the depth away from the viewer, 0 at the mean face's
            centroid. For 3D regression, x and y are ``landmarks``; for 3D alignment they are as near as it comes.
        pose: (3,) roll, pitch and yaw in degrees: clockwise as seen, looking up, nose to the image's left.
        scale: s of Eq. 15, pixels per pixel of the canonical face.
        b: (M,) coefficients of the 3D shape model.
    """

    landmarks: Landmarks
    landmarks_3d: Landmarks3D
    pose: Float[Array, "3"]
    scale: Scalar
    b: Coefficients


@computing
def fit_heads(
    cascade: Cascade,
    crops: _Given,
    starts: Starts = Starts(),
    passes: int = 1,
    aligned: ShapeSpace3D | None = None,
) -> Heads:
    """Landmarks, 3D shape and pose of a batch of crops, in crop pixels, in one compiled function.

    Args:
        cascade: a trained cascade, on a 3D shape space if there is no ``aligned``.
        crops: as in :func:`fit_crops`.
        starts: as in :func:`fit_crops`.
        passes: as in :func:`fit_crops`.
        aligned: align this 3D shape space to the landmarks that a 2D cascade finds (thesis 3.3); None takes the
            cascade's own parameters (3.4).

    Raises:
        InputError: crops of another size or type, no passes, or a 2D cascade with nothing to align.
    """
    _require_crops(cascade, crops, passes)
    return _fit_heads(cascade, crops, starts, passes, aligned)


@partial(jax.jit, static_argnames="passes")
def _fit_heads(cascade: Cascade, crops: Array, starts: Starts, passes: int, aligned: ShapeSpace3D | None) -> Heads:
    return _heads(cascade, aligned, _best(cascade, _descended(cascade, crops, starts.rotations, passes).last))


def heads_of(space: ShapeSpace3D, landmarks: Landmarks, params: Params) -> Heads:
    """What a 3D shape space says of a face at these parameters, whose landmarks were found."""
    return Heads(landmarks, space.landmarks_3d(params), space.pose(params), space.scale(params), space.b(params))


def _landmarks(cascade: Cascade, states: State) -> Float[Array, "faces landmarks 2"]:
    """The landmarks of states (faces)."""
    return vmap(partial(landmarks_of, cascade.space))(states)


def _heads(cascade: Cascade, aligned: ShapeSpace3D | None, states: State) -> Heads:
    """What stands in `Heads`, of states (faces)."""
    space, space_3d = cascade.space, space_3d_of(cascade, aligned)
    if space_3d is None:
        raise InputError("expected a cascade of 3D regression, or a 3D shape space to align to a 2D one's landmarks")

    def head(state: State) -> Heads:
        landmarks = landmarks_of(space, state)
        regressed = space.turned(state.params, state.angle)
        return heads_of(space_3d, landmarks, regressed if aligned is None else aligned.encode(landmarks))

    if aligned is not None and aligned.steady:
        return vmap(head)(states)
    # Alignments take rounds until they converge: side by side, all would take as many as the slowest.
    return lax.map(head, states, batch_size=_ALIGNED_AT_ONCE)


def _clues(cascade: Cascade, descent: Descent) -> Clues:
    """The clues (faces) of the best fits."""
    landmarks = partial(landmarks_of, cascade.space)
    fits = vmap(vmap(landmarks))(descent.last)
    begun = jax.tree.map(lambda first, each: jnp.concatenate([first[None], each]), descent.first, descent.each)

    def of_face(fits: Array, path: State, features: Array) -> Clues:
        chosen = centroid(fits)
        of_chosen = jax.tree.map(lambda values: values[:, chosen], path)
        return Clues(features[chosen], moves_of(vmap(landmarks)(of_chosen), fits))

    return vmap(of_face, (0, 1, 0))(fits, begun, descent.features)


def _best(cascade: Cascade, states: State) -> State:
    """The best (faces) of the fits (faces, starts) of each crop."""

    def best(states: State) -> State:
        chosen = centroid(vmap(partial(landmarks_of, cascade.space))(states))
        return jax.tree.map(lambda values: values[chosen], states)

    return vmap(best)(states)


def _require_crops(cascade: Cascade, crops: Any, passes: int) -> None:
    """Check what a cascade is to be run on, and how often.

    Raises:
        InputError: crops of another size or type, or no passes.
    """
    side, kind = cascade.frame.crop, type(crops)
    if not isinstance(crops, np.ndarray | jax.Array):
        raise InputError(
            f"expected crops as an array of NumPy or JAX, uint8 (N, {side}, {side}), as jaxfit.crop_faces cuts them; "
            f"got {kind.__module__.partition('.')[0]}.{kind.__name__}"
        )
    if crops.shape[1:] != (side, side):
        raise InputError(f"expected crops (N, {side}, {side}) as jaxfit.crop_faces cuts them; got {crops.shape}")
    if crops.dtype != jnp.uint8:  # white may be 1 in others: gradients would be weighed wrong, without a word
        raise InputError(f"expected uint8 crops, as jaxfit.crop_faces cuts them; got {crops.dtype}")
    if passes < 1:
        raise InputError(f"expected at least one pass; got {passes}")


def _descended(
    cascade: Cascade, crops: UInt8[Array, "faces height width"], rotations: Float[Array, "starts"], passes: int
) -> Descent:
    """The last pass of `descend` in crops, the first from starts of these rotations."""
    _require_crops(cascade, crops, passes)
    prepared = vmap(cascade.descriptor.prepare)(crops)

    def once(states: State, _: None) -> tuple[State, Descent]:
        descent = descend(cascade, prepared, states)
        again = vmap(partial(_start_over, cascade))(_best(cascade, descent.last))
        return jax.tree.map(lambda part: part[:, None], again), descent

    states = _started(cascade, len(crops), starts_of(cascade.space, cascade.frame, rotations))
    if passes > 1 and len(rotations) > 1:  # later passes have a single start
        states, passes = once(states, None)[0], passes - 1
    if passes == 1:
        return descend(cascade, prepared, states)
    # As a loop, which is compiled once.
    return jax.tree.map(lambda part: part[-1], lax.scan(once, states, length=passes)[1])


def _start_over(cascade: Cascade, state: State) -> State:
    """Where a next pass starts: the mean face, turned as a fit is if the descriptor turns, with its bounding square."""
    space, descriptor = cascade.space, cascade.descriptor
    rotation = space.rotation(state.params) + state.angle if descriptor.turns else jnp.zeros_like(state.angle)
    upright = jax.tree.map(lambda part: part[0], starts_of(space, cascade.frame, rotation[None]))
    middle, side = square_around(space.landmarks(space.place(upright)))
    there, as_large = square_around(landmarks_of(space, state))
    scale = as_large / side
    centre = there + scale * (upright.centre - middle)
    return state_of(descriptor, space, space.place(Start(centre, upright.scale * scale, rotation)))


def fit_starts(
    cascade: Cascade, crops: UInt8[Array, "faces height width"], starts: Start
) -> Float[Array, "faces starts landmarks 2"]:
    """Fit every crop from several starts (a leading axis): the landmarks of every fit."""
    prepared = vmap(cascade.descriptor.prepare)(crops)
    descent = descend(cascade, prepared, _started(cascade, len(crops), starts))
    return vmap(vmap(partial(landmarks_of, cascade.space)))(descent.last)


def _started(cascade: Cascade, faces: int, starts: Start) -> State:
    """States (faces, starts): the same starts for each of so many faces."""
    descriptor, space = cascade.descriptor, cascade.space
    states = vmap(lambda start: state_of(descriptor, space, space.place(start)))(starts)
    return jax.tree.map(lambda part: jnp.broadcast_to(part, (faces, *part.shape)), states)
