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


class Hidden(NamedTuple):
    """A hidden layer on what a linear map found: the part of a step that is not linear, such as what holds for
    turned faces alone. Arrays of one step, or of S with a leading axis.

    Attributes:
        weights: (O, U) of the linear map's outputs.
        biases: (U,) of the hidden units.
        output: (U, P) what each unit adds to the step.
    """

    weights: Float[Array, "*steps outputs units"]
    biases: Float[Array, "*steps units"]
    output: Float[Array, "*steps units params"]

    def __call__(self, found: Float[Array, "*samples outputs"]) -> Float[Array, "*samples params"]:
        """What is added to the steps of these linear outputs."""
        units = jnp.tanh(jnp.matmul(found, self.weights, precision=lax.Precision.HIGHEST) + self.biases)
        return jnp.matmul(units, self.output, precision=lax.Precision.HIGHEST)


class Regressor(NamedTuple):
    """The map of a step: linear, and with hidden units more than that.

    Attributes:
        weights: (F, P), or (F, R) where there are directions.
        bias: (P,).
        directions: (R, P) what the R outputs are steps along; None: the P parameters.
        hidden: of the step; None: the map is linear.
    """

    weights: Float[Array, "features outputs"]
    bias: Float[Array, "params"]
    directions: Float[Array, "rank params"] | None
    hidden: Hidden | None = None

    def predict(self, features: Float[Array, "*samples features"]) -> Float[Array, "*samples params"]:
        """The steps that features ask for; as exact as float32 is, whatever the device, as later steps learn to follow
        these."""
        found = jnp.matmul(features, self.weights, precision=lax.Precision.HIGHEST)
        step = found
        if self.directions is not None:
            step = jnp.matmul(found, self.directions, precision=lax.Precision.HIGHEST)
        step = step + self.bias
        return step if self.hidden is None else step + self.hidden(found)


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
        hidden: hidden units of the S steps, which fine-tuning may add; None: the steps are linear.
    """

    space: ShapeSpace
    weights: tuple[Float[Array, "features outputs"], ...]
    biases: Float[Array, "steps params"]
    windows: Float[Array, "steps"]
    descriptor: Descriptor = field(metadata={"static": True})
    frame: Frame = field(metadata={"static": True})
    directions: Float[Array, "steps rank params"] | None = None
    hidden: Hidden | None = None

    def regressor(self, step: int) -> Regressor:
        """The map of a step."""
        rest = (self.biases, self.directions, self.hidden)
        return Regressor(self.weights[step], *jax.tree.map(lambda part: part[step], rest))


@computing
def first_steps(cascade: Cascade, count: int) -> Cascade:
    """The first ``count`` steps of a cascade: what training with as many gives, as steps do not know of later ones."""
    arrays = (cascade.biases, cascade.windows, cascade.directions, cascade.hidden)
    biases, windows, directions, hidden = jax.tree.map(lambda part: part[:count], arrays)
    weights = cascade.weights[:count]
    return replace(cascade, weights=weights, biases=biases, windows=windows, directions=directions, hidden=hidden)
