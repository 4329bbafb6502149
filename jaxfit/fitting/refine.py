"""Refining 3D alignments: shape and camera adjusted together, after a fit."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxfit.cascade.fit import Heads, heads_of
from jaxfit.errors import InputError
from jaxfit.fitting.fits import Fits
from jaxfit.models.model import Model
from jaxfit.modes import computing
from jaxfit.shapes.space import ShapeSpace3D
from jaxfit.types import Landmarks

_AT_ONCE = 4  # few, as they wait for each other
_BATCH = 64  # faces of one compilation, whatever their number


@computing
def refine(model: Model, fits: Fits) -> Fits:
    """Fits of a model of 3D alignment, with the coefficients and the camera adjusted together
    (``shapes.alignment.refine_head``); slow. The 2D landmarks stay what they are.

    Args:
        model: whose fits.
        fits: N faces.

    Raises:
        InputError: the model aligns no 3D shape, or the fits are another model's.
    """
    require_refinable(model)
    assert model.aligned is not None
    if fits.scheme.name != model.scheme.name or fits.b is None or fits.b.shape[1] != model.aligned.modes:
        raise InputError("refine: expected fits of the model that is to refine them; got another model's")
    rows = np.flatnonzero(fits.fitted)
    if not len(rows):
        return fits
    landmarks = fits.landmarks[rows]
    # As in crops: float32 would lose sub-pixels in the corner of a large picture.
    low, high = landmarks.min(1), landmarks.max(1)
    middle, size = (low + high) / 2, np.maximum((high - low).max(1), 1e-6) / model.cascade.frame.face
    points = (landmarks - middle[:, None]) / size[:, None, None]
    padded = np.pad(points, ((0, -len(points) % _BATCH), (0, 0), (0, 0)), mode="edge").astype(np.float32)
    parts = [_refined(model.aligned, padded[first : first + _BATCH]) for first in range(0, len(padded), _BATCH)]
    found: Heads = jax.tree.map(lambda *each: np.concatenate(each)[: len(rows)].astype(np.float64), *parts)
    flat = found.landmarks_3d[..., :2] * size[:, None, None] + middle[:, None]
    depths = found.landmarks_3d[..., 2:] * size[:, None, None]
    refined: dict[str, Any] = {
        "landmarks_3d": np.concatenate([flat, depths], -1),
        "pose": found.pose,
        "scale": found.scale * size,
        "b": found.b,
    }
    return replace(fits, **{name: _put(fits.arrays[name], rows, values) for name, values in refined.items()})


def require_refinable(model: Model) -> None:
    """Check that a model aligns a 3D shape, which could be refined.

    Raises:
        InputError: it does not.
    """
    if model.aligned is None:
        raise InputError(
            "refine: only models of the method alignment3d, and 2D models with heads (--heads, jaxfit.with_heads), "
            "align a 3D shape that could be refined"
        )


@jax.jit
def _refined(space: ShapeSpace3D, landmarks: Float[Array, "faces landmarks 2"]) -> Heads:
    def head(landmarks: Landmarks) -> Heads:
        return heads_of(space, landmarks, space.refined(landmarks))

    return lax.map(head, landmarks, batch_size=_AT_ONCE)


def _put(values: np.ndarray, rows: np.ndarray, new: np.ndarray) -> Any:
    changed = values.copy()
    changed[rows] = new
    return changed
