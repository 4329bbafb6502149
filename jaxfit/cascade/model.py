"""The parameters of a cascade, as one pytree: a leading step axis, but each step's weights an array of their own."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.image.frame import Frame
from jaxfit.modes import computing
from jaxfit.shapes.space import ShapeSpace


class Regressor(NamedTuple):
    """The linear map of a step.

    Attributes:
        weights: (F, P), or (F, R) where there are directions.
        bias: (P,).
        directions: (R, P) what the R outputs are steps along; None: the P parameters.
    """

    weights: Float[Array, "features outputs"]
    bias: Float[Array, "params"]
    directions: Float[Array, "rank params"] | None

    def predict(self, features: Float[Array, "*samples features"]) -> Float[Array, "*samples params"]:
        """The steps that features ask for; as exact as float32 is, whatever the device, as later steps learn to follow
        these."""
        found = jnp.matmul(features, self.weights, precision=lax.Precision.HIGHEST)
        if self.directions is not None:
            found = jnp.matmul(found, self.directions, precision=lax.Precision.HIGHEST)
        return found + self.bias


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cascade:
    """A trained cascade; a pytree, so it can be an argument of jitted functions.

    Attributes:
        space: the shape space that the regressors work in.
        weights: S arrays (F, P), the regressors, one a step, the PCA folded in; (F, R) where there are directions. They
            are arrays of their own, as XLA would copy a part of a larger one, some megabytes, before each use.
        biases: (S, P) their intercepts.
        windows: (S,) side of the descriptor window of each step in pixels of a face of scale 1.
        descriptor: what is seen at a landmark (static).
        frame: size of the crops (static).
        directions: (S, R, P) orthonormal directions of parameters that each step is taken along; None: along all.
    """

    space: ShapeSpace
    weights: tuple[Float[Array, "features outputs"], ...]
    biases: Float[Array, "steps params"]
    windows: Float[Array, "steps"]
    descriptor: Descriptor = field(metadata={"static": True})
    frame: Frame = field(metadata={"static": True})
    directions: Float[Array, "steps rank params"] | None = None


@computing
def first_steps(cascade: Cascade, count: int) -> Cascade:
    """The first ``count`` steps of a cascade: what training with as many gives, as steps do not know of later ones."""
    directions = None if cascade.directions is None else cascade.directions[:count]
    return replace(
        cascade,
        weights=cascade.weights[:count],
        biases=cascade.biases[:count],
        windows=cascade.windows[:count],
        directions=directions,
    )
