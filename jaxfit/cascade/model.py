"""The parameters of a cascade, as one pytree with a leading step axis."""

from dataclasses import dataclass, field, replace

import jax
from jaxtyping import Array, Float

from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.image.frame import Frame
from jaxfit.shapes.space import ShapeSpace


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cascade:
    """A trained cascade; a pytree, so it can be an argument of jitted functions.

    Attributes:
        space: the shape space that the regressors work in.
        weights: (S, F, P) regressors, one a step, the PCA folded in; (S, F, R) where there are directions.
        biases: (S, P) their intercepts.
        windows: (S,) side of the descriptor window of each step in pixels of a face of scale 1.
        descriptor: what is seen at a landmark (static).
        frame: size of the crops (static).
        directions: (S, R, P) orthonormal directions of parameters that each step is taken along; None: along all.
    """

    space: ShapeSpace
    weights: Float[Array, "steps features outputs"]
    biases: Float[Array, "steps params"]
    windows: Float[Array, "steps"]
    descriptor: Descriptor = field(metadata={"static": True})
    frame: Frame = field(metadata={"static": True})
    directions: Float[Array, "steps rank params"] | None = None


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
