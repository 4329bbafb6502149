"""3D ground truth from 2D labels (thesis 4.2)."""

import jax
import numpy as np
from jax import numpy as jnp

from jaxfit.shapes.alignment import align_head
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.camera import show


def with_depth(landmarks: np.ndarray, model: ActiveShapeModel) -> np.ndarray:
    """Labels (N, L, 3): x and y as they are, and the depths of the 3D shape model that is aligned to them.

    Args:
        landmarks: (N, L, 2) labels in pixels; NaN where unknown, and so is then the third.
        model: 3D shape model of the L landmarks.

    Returns:
        (N, L, 3) pixels; depth is away from the viewer, 0 at the mean face's centroid. NaN for faces whose labels do
        not determine the alignment.
    """
    known = np.isfinite(landmarks).all(-1)
    filled = np.where(known[..., None], landmarks, 0.0)
    # float32 would lose sub-pixels in the corner of a large picture.
    share = known / np.maximum(known.sum(-1, keepdims=True), 1)
    middles = np.einsum("nl,nld->nd", share, filled)
    centred = jnp.asarray(filled - middles[:, None], jnp.float32)
    depths, ok = _depths(model, centred, jnp.asarray(known, jnp.float32))
    depths = np.where(known & np.asarray(ok)[:, None], np.asarray(depths, np.float64), np.nan)
    return np.concatenate([np.where(known[..., None], landmarks, np.nan), depths[..., None]], -1)


@jax.jit
def _depths(model: ActiveShapeModel, points: jax.Array, weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    def one(points: jax.Array, weights: jax.Array) -> tuple[jax.Array, jax.Array]:
        alignment = align_head(model, points, weights)
        return show(model.reconstruct(alignment.b), alignment.camera)[:, 2], alignment.camera.ok

    return jax.vmap(one)(points, weights)
