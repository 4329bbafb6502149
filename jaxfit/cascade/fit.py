"""Running a cascade: one face from one start; then a batch of crops, each from one or several starts."""

from typing import Any

import jax
from jax import lax, vmap
from jax import numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxfit.cascade.model import Cascade
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.exceptions import InputError
from jaxfit.image.frame import Frame
from jaxfit.shapes.space import ShapeSpace, Start
from jaxfit.types import Crop, Features, Landmarks, Params, Scalar

# Faces whose windows are sampled together: few enough to stay in the processor's cache.
FACES_AT_ONCE = 4


def features_at(descriptor: Descriptor, space: ShapeSpace, prepared: Any, params: Params, window: Scalar) -> Features:
    """The concatenated descriptors of one face; ``window`` is the side, in pixels, for a face of scale 1."""
    side = window * space.scale(params)
    described = vmap(lambda point: descriptor.describe(prepared, point, side))(space.landmarks(params))
    return described.reshape(-1)


def fit_face(cascade: Cascade, crop: Crop, params: Params) -> Params:
    """Fit one face from one start: parameters in, parameters out.

    A plain function to ``jit``, ``vmap`` and ``grad`` as you like. Differentiable in everything but the hard
    orientation bins of its descriptors.
    """
    prepared = cascade.descriptor.prepare(crop)

    def step(params: Params, layer: tuple[Array, Array, Array]) -> tuple[Params, None]:
        weights, bias, window = layer
        seen = features_at(cascade.descriptor, cascade.space, prepared, params, window)
        return cascade.space.advance(params, seen @ weights + bias), None

    return lax.scan(step, params, (cascade.weights, cascade.biases, cascade.windows))[0]


def starts_of(frame: Frame, rotations: Float[Array, "starts"]) -> Start:
    """Starts in the middle of the crop at the canonical size, one for each rotation in radians."""
    count = rotations.shape[0]
    return Start(jnp.full((count, 2), frame.middle), jnp.ones(count), rotations)


def centroid(candidates: Float[Array, "starts landmarks 2"]) -> Int[Array, ""]:
    """Index of the candidate with the smallest sum of point distances to the others (thesis 3.2.3, Eq. 12).

    Candidates that diverged, with coordinates that are not finite, are neither kept nor counted.
    """
    finite = jnp.isfinite(candidates).all((1, 2))
    known = jnp.where(finite[:, None, None], candidates, 0.0)
    distances = jnp.sqrt(jnp.sum((known[:, None] - known[None, :]) ** 2, -1)).sum(2)
    return jnp.argmin(jnp.where(finite, distances @ finite.astype(distances.dtype), jnp.inf))


def fit_starts(cascade: Cascade, crop: Crop, starts: Start) -> Landmarks:
    """Fit one face from several starts (a leading axis) and keep the centroid of the fits."""
    space = cascade.space
    fits = vmap(lambda start: fit_face(cascade, crop, space.place(start)))(starts)
    candidates = vmap(space.landmarks)(fits)
    return candidates[centroid(candidates)]


@jax.jit
def fit_crops(
    cascade: Cascade,
    crops: UInt8[Array, "faces height width"],
    rotations: Float[Array, "starts"] | None = None,
) -> Float[Array, "faces landmarks 2"]:
    """Landmarks of a batch of crops, in crop pixels: the whole cascade in one compiled function.

    Args:
        cascade: a trained cascade.
        crops: uint8 grey crops of ``cascade.frame``, the expected face upright in the middle at the canonical size,
            as ``jaxfit.crop_faces`` cuts them.
        rotations: start from each of these rotations, in radians, and keep the centroid; None starts upright.

    Raises:
        InputError: crops of another size.
    """
    side = cascade.frame.crop
    if crops.shape[1:] != (side, side):
        raise InputError(f"expected crops (N, {side}, {side}) as jaxfit.crop_faces cuts them; got {crops.shape}")
    starts = starts_of(cascade.frame, jnp.zeros(1) if rotations is None else rotations)
    return lax.map(lambda crop: fit_starts(cascade, crop, starts), crops, batch_size=FACES_AT_ONCE)
