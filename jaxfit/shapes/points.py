"""The shape space of the original SDM: the parameters are the landmarks themselves."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.shapes.procrustes import align_similarity
from jaxfit.shapes.space import Start, rotate
from jaxfit.types import Landmarks, Params, Scalar


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PointSpace:
    """Landmarks as ``x0, y0, x1, y1, …`` in crop pixels.

    Attributes:
        mean: (L, 2) the mean face at canonical size, its centroid at the origin, in pixels.
    """

    mean: Landmarks

    dimensions: ClassVar[int] = 2

    @property
    def size(self) -> int:
        """Number of parameters, 2 L."""
        return 2 * self.mean.shape[0]

    @property
    def closed_under_rotation(self) -> bool:
        """Points may lie anywhere."""
        return True

    def landmarks(self, params: Params) -> Landmarks:
        """The parameters, as points."""
        return params.reshape(-1, 2)

    def scale(self, params: Params) -> Scalar:
        """Root mean square distance of the points from their centroid, relative to the mean face's."""
        return _radius(self.landmarks(params)) / _radius(self.mean)

    def rotation(self, params: Params) -> Scalar:
        """That of the similarity which brings the mean face nearest to the points."""
        return align_similarity(self.landmarks(params), self.mean).rotation

    def turned(self, params: Params, angle: Scalar) -> Params:
        """The points, turned."""
        return self.encode(rotate(self.landmarks(params), angle))

    def encode(self, landmarks: Landmarks) -> Params:
        """The landmarks, as parameters."""
        return landmarks.reshape(-1)

    def place(self, start: Start) -> Params:
        """The mean face, rotated, scaled and moved to a start."""
        return self.encode(rotate(start.scale * self.mean, start.rotation) + start.centre)

    def difference(self, target: Params, params: Params) -> Float[Array, "params"]:
        """Displacements in units of the current size.

        The thesis regresses pixels; in units of the size, one regressor serves starts of all sizes, whose windows
        grow with them.
        """
        return (target - params) / self.scale(params)

    def advance(self, params: Params, step: Float[Array, "params"]) -> Params:
        """Move the points by displacements in units of the current size."""
        return params + self.scale(params) * step


def _radius(points: Landmarks) -> Scalar:
    squared = jnp.mean(jnp.sum((points - points.mean(0)) ** 2, 1))
    # Coincident points: a floor keeps the derivative of the root and later divisions finite.
    return jnp.sqrt(jnp.maximum(squared, 1e-6))


def mean_face(landmarks: np.ndarray, side: float) -> np.ndarray:
    """The mean (L, 2) of faces (N, L, 2) in units of their boxes: centroid at the origin, bounding square ``side``."""
    mean = landmarks.mean(0)
    mean = mean - mean.mean(0)
    return mean * (side / np.ptp(mean, 0).max())
