"""How far each landmark of a fit may be off, and whether it can be seen: from what the cascade sees and does."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.cascade.confidence import Clues
from jaxfit.types import Landmarks, Scalar

_EXACT = lax.Precision.HIGHEST
OUTPUTS = 4  # of each landmark: what `Uncertainty.raw` says
_SMALLEST, _LARGEST = -7.0, 1.0  # logarithms of deviations in sizes of the face: covariances stay finite and positive


class Doubt(NamedTuple):
    """What is known of the landmarks of a face, or of several with leading axes, beside where they are.

    Attributes:
        covariances: (L, 2, 2) of the errors in x and y, in pixels².
        visible: (L,) the probability that a landmark can be seen: that neither the face itself nor anything else hides
            it.
    """

    covariances: Float[Array, "landmarks 2 2"]
    visible: Float[Array, "landmarks"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Uncertainty:
    """A network of one hidden layer on the clues of a face, and a linear map of each landmark's own descriptor, in
    which PCA, whitening and calibration are folded.

    Attributes:
        seen: (F, H) weights of all descriptors.
        moved: (C, H) weights of the moves.
        biases: (H,) of the hidden units.
        own: (L, D, 4) weights of each landmark's own descriptor.
        output: (H, L, 4) weights of the hidden units.
        offset: (L, 4) of the outputs.
    """

    seen: Float[Array, "features hidden"]
    moved: Float[Array, "moves hidden"]
    biases: Float[Array, "hidden"]
    own: Float[Array, "landmarks descriptor 4"]
    output: Float[Array, "hidden landmarks 4"]
    offset: Float[Array, "landmarks 4"]

    def __call__(self, clues: Clues, landmarks: Landmarks) -> Doubt:
        """What the clues say of the landmarks (L, 2) of a fit, in pixels."""
        raw = self.raw(clues)
        return Doubt(covariances_of(raw) * size_of(landmarks) ** 2, jax.nn.sigmoid(raw[:, 3]))

    def raw(self, clues: Clues) -> Float[Array, "landmarks 4"]:
        """Of each landmark, the logarithms of the Cholesky factor's two diagonal entries and its third one, in sizes of
        the face, and the logarithm of the odds that it is visible."""
        described = jnp.matmul(clues.features, self.seen, precision=_EXACT)
        moved = jnp.matmul(clues.moves, self.moved, precision=_EXACT)
        units = jnp.tanh(described + moved + self.biases)
        each = clues.features.reshape(len(self.own), -1)
        own = jnp.einsum("ld,ldo->lo", each, self.own, precision=_EXACT)
        return own + jnp.einsum("h,hlo->lo", units, self.output, precision=_EXACT) + self.offset


def factors_of(raw: Float[Array, "*n 4"]) -> Float[Array, "*n 2 2"]:
    """The Cholesky factors of covariances, lower triangles, from what `Uncertainty.raw` says, in sizes of the face."""
    first, second = (jnp.exp(jnp.clip(raw[..., part], _SMALLEST, _LARGEST)) for part in (0, 1))
    # As large as the diagonal at most: the ellipse gets no thinner than float32 can say.
    slope = first * jnp.tanh(raw[..., 2])
    zero = jnp.zeros_like(first)
    return jnp.stack([jnp.stack([first, zero], -1), jnp.stack([slope, second], -1)], -2)


def covariances_of(raw: Float[Array, "*n 4"]) -> Float[Array, "*n 2 2"]:
    """The covariances from what `Uncertainty.raw` says, in squares of the face's size."""
    factors = factors_of(raw)
    return jnp.einsum("...ij,...kj->...ik", factors, factors, precision=_EXACT)


def size_of(landmarks: Landmarks) -> Scalar:
    """The size of a face that deviations are relative to: the root mean square distance of its landmarks from their
    centroid, in pixels, above 0."""
    offsets = landmarks - landmarks.mean(0)
    return jnp.sqrt(jnp.maximum(jnp.mean(jnp.sum(offsets**2, 1)), 1e-6))
