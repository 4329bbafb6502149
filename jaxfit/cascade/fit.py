"""Running a cascade: one face from one start; then a batch of crops, each from one or several starts."""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import lax, vmap
from jax import numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxfit.cascade.confidence import Clues, Confidence, moves_of
from jaxfit.cascade.model import Cascade, Regressor
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.exceptions import InputError
from jaxfit.image.frame import Frame
from jaxfit.shapes.asm import Coefficients
from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.space import ShapeSpace, Start, rotate
from jaxfit.types import Crop, Landmarks, Landmarks3D, Params, Point, Scalar

# Few, as they wait for each other; several, as a single one does not fill the processor's vectors.
_ALIGNED_AT_ONCE = 4
_FAR = 1e4  # pixels, many crops
# Degrees: what several starts cover unless told otherwise. Faces upside down are left out, as in the thesis.
ANY_ROTATION = (-90.0, 90.0)


class State(NamedTuple):
    """A face in a frame that may be turned against the crop, about the crop's first pixel.

    A descriptor whose windows turn with the face sees all faces upright, so that steps are learned and taken in a
    frame that is turned with the face, too: a turned picture is then no harder than an upright one.

    Attributes:
        params: (P,) the face in the frame.
        angle: of the frame, in radians, clockwise as seen; 0 for descriptors that do not turn.
    """

    params: Params
    angle: Scalar


def state_of(descriptor: Descriptor, space: ShapeSpace, params: Params) -> State:
    """The state of a face that is given in the crop."""
    return followed(descriptor, space, State(params, jnp.zeros(())))


def followed(descriptor: Descriptor, space: ShapeSpace, state: State) -> State:
    """The state with the frame turned until the face is upright in it, if the descriptor turns."""
    if not descriptor.turns:
        return state
    angle = space.rotation(state.params)
    return State(space.turned(state.params, -angle), state.angle + angle)


def landmarks_of(space: ShapeSpace, state: State) -> Landmarks:
    """The landmarks of a state, in crop pixels."""
    return rotate(space.landmarks(state.params), state.angle)


def features_of(
    descriptor: Descriptor, space: ShapeSpace, prepared: Any, states: State, window: Scalar
) -> Float[Array, "faces starts features"]:
    """The concatenated descriptors of states (faces, starts), in crops (faces) that the descriptor has prepared.

    ``window`` is the side, in pixels, for a face of scale 1.
    """
    points = vmap(vmap(partial(landmarks_of, space)))(states)
    sides = window * vmap(vmap(space.scale))(states.params)

    def aims_at(level: int, prepared: Any, points: Landmarks, side: Scalar, angle: Scalar) -> Any:
        return vmap(lambda point: descriptor.aim(prepared, level, point, side, angle))(points)

    def of_start(level: int, prepared: Any, aims: Any, angle: Scalar) -> Float[Array, "landmarks cells bins"]:
        return vmap(lambda aim: descriptor.describe(prepared, level, aim, angle))(aims)

    def of_faces(level: int) -> Float[Array, "faces starts landmarks cells bins"]:
        aims = vmap(vmap(partial(aims_at, level), (None, 0, 0, 0)))(prepared, points, sides, states.angle)

        def of_face(face: tuple[Any, Any, Array]) -> Array:
            prepared, aims, angles = face
            if len(angles) == 1:  # where a loop would cost a tenth of the time
                return vmap(partial(of_start, level, prepared))(aims, angles)
            return lax.map(lambda start: of_start(level, prepared, *start), (aims, angles))

        # One start after the other: what is looked up then stays in the processor's cache.
        return lax.map(of_face, (prepared, aims, states.angle))

    found = lax.switch(descriptor.level(window), [partial(of_faces, level) for level in range(descriptor.levels)])
    features = vmap(vmap(vmap(descriptor.normalise)))(found)
    return features.reshape(*features.shape[:2], points.shape[2] * descriptor.size)


def target_of(descriptor: Descriptor, space: ShapeSpace, landmarks: Landmarks) -> State:
    """The state that fitting should arrive at, for known landmarks in the crop."""
    angle = state_of(descriptor, space, space.encode(landmarks)).angle
    return State(space.encode(rotate(landmarks, -angle)), angle)


def step_to(space: ShapeSpace, target: State, state: State) -> Float[Array, "params"]:
    """The step that leads from a state to a target: what a regressor learns."""
    return space.difference(space.turned(target.params, target.angle - state.angle), state.params)


def advanced(descriptor: Descriptor, space: ShapeSpace, state: State, step: Float[Array, "params"]) -> State:
    """The state after a step."""
    return followed(descriptor, space, State(space.advance(state.params, step), state.angle))


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
        carried: tuple[State, Array], part: tuple[Array, Array, Array | None, Scalar]
    ) -> tuple[tuple[State, Array], State]:
        states, _ = carried
        number, bias, directions, window = part
        features = features_of(descriptor, space, prepared, states, window)
        regressors = [Regressor(weights, bias, directions) for weights in cascade.weights]
        # All faces and starts at once, so that the weights, megabytes, are read once.
        states = move(states, lax.switch(number, [regressor.predict for regressor in regressors], features))
        return (states, features), states

    numbers = jnp.arange(len(cascade.weights))
    unseen = jnp.zeros((*states.angle.shape, cascade.weights[0].shape[0]))
    (last, features), each = lax.scan(
        step, (states, unseen), (numbers, cascade.biases, cascade.directions, cascade.windows)
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


def start_rotations(initialisations: int, rotations: tuple[float, float]) -> Float[Array, "starts"]:
    """Rotations, in radians, of ``initialisations`` starts spread evenly over a range in degrees; one is in its middle.

    Raises:
        InputError: fewer than one, or two, of which none is nearer to the others; or no range.
    """
    check_rotations(initialisations, rotations)
    return _spread_evenly(initialisations, *map(float, rotations))


@cache  # it would take a tenth of the time of a single face
def _spread_evenly(count: int, low: float, high: float) -> Float[Array, "starts"]:
    """``count`` angles in radians, evenly over a range in degrees."""
    full_circle = high - low == 360  # both ends are the same
    several = np.linspace(low, high, count, endpoint=not full_circle)
    degrees = [(low + high) / 2] if count == 1 else several
    with jax.ensure_compile_time_eval():
        return jnp.asarray(np.radians(degrees), jnp.float32)


def check_rotations(initialisations: int, rotations: tuple[float, float]) -> None:
    """Check how many starts are asked for, and between which rotations in degrees.

    Raises:
        InputError: fewer than one, or two, of which none is nearer to the others; or no range.
    """
    ordered = len(rotations) == 2 and -360 <= rotations[0] <= rotations[1] <= min(360, rotations[0] + 360)
    if initialisations < 1 or initialisations == 2 or not ordered:
        raise InputError(
            "expected one initialisation or at least three (of two fits none is nearer to the others), and rotations "
            f"as degrees (lowest, highest) such as (-90, 90); got {initialisations} and {rotations}"
        )


def starts_of(space: ShapeSpace, frame: Frame, rotations: Float[Array, "starts"]) -> Start:
    """Starts for one box, one for each rotation in radians: upright, in the middle of the crop at the canonical size.

    Turned, the mean face is moved and scaled to have the same bounding square as the upright one: around a turned face,
    which is wider or narrower, a box lies differently.
    """
    upright = Start(jnp.full(2, frame.middle), jnp.ones(()), jnp.zeros(()))
    mean = space.landmarks(space.place(upright))

    def turned(rotation: Scalar) -> Start:
        middle, side = bounding_square(mean)
        there, larger = bounding_square(frame.middle + rotate(mean - frame.middle, rotation))
        scale = side / larger
        return Start(middle + scale * (frame.middle - there), scale, rotation)

    return vmap(turned)(rotations)


def bounding_square(points: Landmarks) -> tuple[Point, Scalar]:
    """Centre and side of the smallest square around points."""
    low, high = points.min(0), points.max(0)
    return (low + high) / 2, (high - low).max()


def centroid(candidates: Float[Array, "starts landmarks 2"]) -> Int[Array, ""]:
    """Index of the candidate with the smallest sum of point distances to the others (thesis 3.2.3, Eq. 12).

    Candidates that diverged, with coordinates that are not finite, are neither kept nor counted. Distances count as
    ``_FAR`` at most, lest one fit that is on its way there drowns the others in rounding.
    """
    finite = jnp.isfinite(candidates).all((1, 2))
    known = jnp.where(finite[:, None, None], candidates, 0.0)
    apart = jnp.sqrt(jnp.sum((known[:, None] - known[None, :]) ** 2, -1))
    distances = jnp.minimum(apart, _FAR).sum(2)
    sums = jnp.sum(distances * finite, 1)
    return jnp.argmin(jnp.where(finite, sums, jnp.inf))


@partial(jax.jit, static_argnames=("every_step", "passes"))
def fit_crops(
    cascade: Cascade,
    crops: UInt8[Array, "faces height width"],
    rotations: Float[Array, "starts"] | None = None,
    every_step: bool = False,
    passes: int = 1,
) -> Float[Array, "faces *steps landmarks 2"]:
    """Landmarks of a batch of crops, in crop pixels: the whole cascade in one compiled function.

    Args:
        cascade: a trained cascade.
        crops: uint8 grey crops of ``cascade.frame``, the expected face upright in the middle at the canonical size,
            as ``jaxfit.crop_faces`` cuts them.
        rotations: start from each of these rotations, in radians, and keep the centroid; None starts upright.
        every_step: give the landmarks after each step, in a second axis, and not after the last alone; of the last
            pass.
        passes: how often the cascade is run, each time from the mean face where the pass before found one.

    Raises:
        InputError: crops of another size, no rotations, or no passes.
    """
    descent = _descended(cascade, crops, rotations, passes)
    return _landmarks(cascade, _best(cascade, descent, every_step), every_step)


def solid_of(cascade: Cascade, head: CameraASM | None) -> CameraASM | None:
    """The shape space of the 3D results of a cascade and of what is aligned to its landmarks; None: there are none."""
    return cascade.space if head is None and isinstance(cascade.space, CameraASM) else head


def find(
    cascade: Cascade,
    head: CameraASM | None,
    crops: UInt8[Array, "faces height width"],
    rotations: Float[Array, "starts"] | None = None,
    refine: bool = False,
    every_step: bool = False,
    passes: int = 1,
    confidence: Confidence | None = None,
) -> dict[str, Array]:
    """All that a model finds in a batch of crops, by its name in `Heads`: the landmarks alone where nothing is 3D.

    With a ``confidence`` also that, (faces,), unless fits after every step are asked for.
    """
    descent = _descended(cascade, crops, rotations, passes)
    best = _best(cascade, descent, every_step)
    if solid_of(cascade, head) is None:
        found = {"landmarks": _landmarks(cascade, best, every_step)}
    else:
        found = _heads(cascade, head, best, refine, every_step)._asdict()
    if confidence is not None and not every_step:
        found["confidence"] = vmap(confidence)(_clues(cascade, descent))
    return found


@partial(jax.jit, static_argnames="passes")
def find_clues(
    cascade: Cascade,
    crops: UInt8[Array, "faces height width"],
    rotations: Float[Array, "starts"] | None = None,
    passes: int = 1,
) -> tuple[Float[Array, "faces landmarks 2"], Clues]:
    """What a model's confidence learns from: the landmarks that `fit_crops` gives, with the same arguments, and the
    clues of these fits."""
    descent = _descended(cascade, crops, rotations, passes)
    return _landmarks(cascade, _best(cascade, descent, every_step=False), every_step=False), _clues(cascade, descent)


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


@partial(jax.jit, static_argnames=("refine", "every_step", "passes"))
def fit_heads(
    cascade: Cascade,
    crops: UInt8[Array, "faces height width"],
    rotations: Float[Array, "starts"] | None = None,
    head: CameraASM | None = None,
    refine: bool = False,
    every_step: bool = False,
    passes: int = 1,
) -> Heads:
    """Landmarks, 3D shape and pose of a batch of crops, in crop pixels, in one compiled function.

    Args:
        cascade: a trained cascade, on :class:`CameraASM` if there is no ``head``.
        crops: as in :func:`fit_crops`.
        rotations: as in :func:`fit_crops`.
        head: align this to the landmarks that a 2D cascade finds (thesis 3.3); None takes the cascade's own
            parameters (3.4).
        refine: adjust coefficients and camera of the alignment together (``shapes.alignment.refine_head``).
        every_step: as in :func:`fit_crops`.
        passes: as in :func:`fit_crops`.

    Raises:
        InputError: crops of another size, no rotations, no passes, a 2D cascade without a head, or nothing to refine.
    """
    descent = _descended(cascade, crops, rotations, passes)
    return _heads(cascade, head, _best(cascade, descent, every_step), refine, every_step)


def _landmarks(cascade: Cascade, states: State, every_step: bool) -> Float[Array, "faces *steps landmarks 2"]:
    """The landmarks of states (faces), or (faces, steps)."""
    landmarks = vmap(partial(landmarks_of, cascade.space))
    return (vmap(landmarks) if every_step else landmarks)(states)


def _heads(cascade: Cascade, head: CameraASM | None, states: State, refine: bool, every_step: bool) -> Heads:
    """What stands in `Heads`, of states (faces), or (faces, steps)."""
    space, solid = cascade.space, solid_of(cascade, head)
    if refine and head is None:
        raise InputError("expected a 3D shape model that is aligned to landmarks: only alignments can be refined")
    if solid is None:
        raise InputError("expected a cascade of 3D regression, or a 3D shape model to align to a 2D one's landmarks")

    def heads(state: State) -> Heads:
        landmarks = landmarks_of(space, state)
        regressed = space.turned(state.params, state.angle)
        params = regressed if head is None else head.encode(landmarks, refine)
        return Heads(landmarks, solid.landmarks_3d(params), solid.pose(params), solid.scale(params), solid.b(params))

    # Alignments take rounds until they converge: side by side, all would take as many as the slowest.
    each = partial(lax.map, heads, batch_size=_ALIGNED_AT_ONCE)
    return lax.map(each, states) if every_step else each(states)


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


def _best(cascade: Cascade, descent: Descent, every_step: bool) -> State:
    """The state (faces) of each crop's best fit; with ``every_step`` (faces, steps), of the best after each step."""

    def best(states: State) -> State:
        chosen = centroid(vmap(partial(landmarks_of, cascade.space))(states))
        return jax.tree.map(lambda values: values[chosen], states)

    return vmap(vmap(best), out_axes=1)(descent.each) if every_step else vmap(best)(descent.last)


def _descended(
    cascade: Cascade, crops: UInt8[Array, "faces height width"], rotations: Float[Array, "starts"] | None, passes: int
) -> Descent:
    """The last pass of `descend` in crops, the first from starts of these rotations, from an upright one if None."""
    side = cascade.frame.crop
    if crops.shape[1:] != (side, side):
        raise InputError(f"expected crops (N, {side}, {side}) as jaxfit.crop_faces cuts them; got {crops.shape}")
    rotations = jnp.zeros(1) if rotations is None else rotations
    if len(rotations) == 0:
        raise InputError("expected at least one rotation to start from; got none")
    if passes < 1:
        raise InputError(f"expected at least one pass; got {passes}")
    prepared = vmap(cascade.descriptor.prepare)(crops)

    def once(states: State, _: None) -> tuple[State, Descent]:
        descent = descend(cascade, prepared, states)
        again = vmap(partial(_start_over, cascade))(_best(cascade, descent, every_step=False))
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
    rotation = space.rotation(state.params) + state.angle if descriptor.turns else jnp.zeros(())
    upright = jax.tree.map(lambda part: part[0], starts_of(space, cascade.frame, rotation[None]))
    middle, side = bounding_square(space.landmarks(space.place(upright)))
    there, as_large = bounding_square(landmarks_of(space, state))
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
