"""3D shape models aligned to labelled landmarks, many faces at a time: their depths (thesis 4.2) and poses."""

from dataclasses import dataclass

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.modes import computing
from jaxfit.shapes.alignment import Alignment, Weights, align_head
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.camera import pose_degrees, rotation_angles, show
from jaxfit.types import Landmarks, Landmarks3D

# Any number of faces is served by one compilation.
_BATCH = 64


@dataclass(frozen=True)
class AlignedHeads:
    """3D shapes as they lie on the labels of N faces.

    Attributes:
        landmarks: (N, L, 3) all points of the shapes, those without a label too, in pixels; depth is away from the
            viewer, 0 at the mean face's centroid.
        pose: (N, 3) roll, pitch and yaw in degrees, as in ``jaxfit.Fits``.
        b: (N, M) coefficients.
        error: (N,) mean distance of the labels from the shapes' points, over the side of the mean face as it is seen.
        ok: (N,) bool, whether the labels determine the alignment; nothing else is to be believed where not.
    """

    landmarks: np.ndarray
    pose: np.ndarray
    b: np.ndarray
    error: np.ndarray
    ok: np.ndarray


@computing
def align_labels(model: ActiveShapeModel, labels: np.ndarray) -> AlignedHeads:
    """Align a 3D shape model to each face's labels (:func:`~jaxfit.shapes.alignment.align_head`).

    Args:
        model: 3D shape model of L landmarks.
        labels: (N, L, 2) in pixels; NaN where unknown.
    """
    known = np.isfinite(labels).all(-1)
    filled = np.where(known[..., None], labels, 0.0)
    # float32 would lose sub-pixels in the corner of a large picture.
    share = known / np.maximum(known.sum(-1, keepdims=True), 1)
    middles = np.einsum("nl,nld->nd", share, filled)
    count = -len(labels) % _BATCH  # faces without labels that fill the last batch
    points, weights = (
        jnp.asarray(np.pad(values, ((0, count), *[(0, 0)] * (values.ndim - 1))), jnp.float32)
        for values in (filled - middles[:, None], known)
    )
    batches = [_align(model, points[n : n + _BATCH], weights[n : n + _BATCH]) for n in range(0, len(points), _BATCH)]
    batches = batches or [_align(model, points, weights)]
    found, landmarks, pose = jax.tree.map(lambda *parts: np.concatenate(parts)[: len(labels)], *batches)
    landmarks = landmarks.astype(np.float64)
    landmarks[..., :2] += middles[:, None]
    side = np.ptp(np.asarray(model.mean), axis=0).max() * found.camera.scale
    error = found.error / np.maximum(side * known.sum(1), 1e-12)
    return AlignedHeads(landmarks, pose.astype(np.float64), found.b, error, found.camera.ok)


def with_depth(labels: np.ndarray, model: ActiveShapeModel) -> np.ndarray:
    """Labels (N, L, 3): x and y as they are, and the depths of the 3D shape model that is aligned to them (4.2).

    Args:
        labels: (N, L, 2) in pixels; NaN where unknown, and so is then the third.
        model: 3D shape model of the L landmarks.

    Returns:
        (N, L, 3) pixels; depth is away from the viewer, 0 at the mean face's centroid. NaN for faces whose labels do
        not determine the alignment.
    """
    known = np.isfinite(labels).all(-1)
    solid = np.full((*labels.shape[:2], 3), np.nan)
    solid[..., :2] = np.where(known[..., None], labels, np.nan)
    if known.any():
        aligned = align_labels(model, labels)
        solid[..., 2] = np.where(known & aligned.ok[:, None], aligned.landmarks[..., 2], np.nan)
    return solid


@jax.jit
def _align(
    model: ActiveShapeModel, points: Float[Array, "faces landmarks 2"], weights: Float[Array, "faces landmarks"]
) -> tuple[Alignment, Float[Array, "faces landmarks 3"], Float[Array, "faces 3"]]:
    def one(points: Landmarks, weights: Weights) -> tuple[Alignment, Landmarks3D, Array]:
        found = align_head(model, points, weights)
        pose = pose_degrees(*rotation_angles(found.camera.rotation))
        return found, show(model.reconstruct(found.b), found.camera), pose

    return jax.vmap(one)(points, weights)
