"""The state of a face in a cascade, and one step of it: where to look, what is seen there, and where that leads."""

from functools import partial
from typing import Any, NamedTuple

from jax import lax, vmap
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.shapes.space import ShapeSpace, rotate
from jaxfit.types import Landmarks, Params, Scalar


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
    return followed(descriptor, space, State(params, jnp.zeros((), params.dtype)))


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
