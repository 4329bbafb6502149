"""How far each landmark of a fit may be off, and whether it can be seen: from what the cascade sees and does."""

import math
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
# Degrees of freedom of the errors' distribution, Student's t in two dimensions: errors of landmarks have heavier tails
# than a Gaussian's.
FREEDOM = 4.0
_SMALLEST, _LARGEST = -7.0, 1.0  # logarithms of deviations in sizes of the face: covariances stay finite and positive


class Doubt(NamedTuple):
    """What is known of the landmarks of a face, or of several with leading axes, beside where they are.

    Attributes:
        covariances: (L, 2, 2) of the errors in x and y, in pixels²; `region_radius` says how far regions reach.
        visible: (L,) the probability that a landmark can be seen: that neither the face itself nor anything else hides
            it.
    """

    covariances: Float[Array, "landmarks 2 2"]
    visible: Float[Array, "landmarks"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Uncertainty:
    """A network of one hidden layer on the clues of a face and its shape, and for each landmark a map of what its own
    descriptor has along some axes, and of the squares of that: they tell what no such landmark looks like. PCA,
    whitening and calibration are folded into the weights.

    Attributes:
        seen: (F, H) weights of all descriptors.
        moved: (C, H) weights of the moves.
        shape: (L, 2, H) weights of the landmarks, in sizes of the face from their centroid.
        biases: (H,) of the hidden units.
        axes: (D, K) of a landmark's own descriptor.
        centre: (K,) of what is along them, on average.
        own: (L, 2, K, 4) weights of what each landmark has along them, and of its squares.
        output: (H, L, 4) weights of the hidden units.
        offset: (L, 4) of the outputs.
    """

    seen: Float[Array, "features hidden"]
    moved: Float[Array, "moves hidden"]
    shape: Float[Array, "landmarks 2 hidden"]
    biases: Float[Array, "hidden"]
    axes: Float[Array, "descriptor axes"]
    centre: Float[Array, "axes"]
    own: Float[Array, "landmarks 2 axes 4"]
    output: Float[Array, "hidden landmarks 4"]
    offset: Float[Array, "landmarks 4"]

    def __call__(self, clues: Clues, landmarks: Landmarks) -> Doubt:
        """What the clues say of the landmarks (L, 2) of a fit, in pixels."""
        raw = self.raw(clues, landmarks)
        variance = FREEDOM / (FREEDOM - 2) * size_of(landmarks) ** 2
        return Doubt(scatters_of(raw) * variance, jax.nn.sigmoid(raw[:, 3]))

    def raw(self, clues: Clues, landmarks: Landmarks) -> Float[Array, "landmarks 4"]:
        """Of each landmark, the logarithms of the Cholesky factor's two diagonal entries and its third one, in sizes of
        the face, and the logarithm of the odds that it is visible."""
        described = jnp.matmul(clues.features, self.seen, precision=_EXACT)
        moved = jnp.matmul(clues.moves, self.moved, precision=_EXACT)
        shaped = jnp.einsum("lc,lch->h", shape_of(landmarks), self.shape, precision=_EXACT)
        units = jnp.tanh(described + moved + shaped + self.biases)
        each = jnp.matmul(clues.features.reshape(len(self.own), -1), self.axes, precision=_EXACT) - self.centre
        own = jnp.einsum("lpk,lpko->lo", jnp.stack([each, each**2], 1), self.own, precision=_EXACT)
        return own + jnp.einsum("h,hlo->lo", units, self.output, precision=_EXACT) + self.offset


def factors_of(raw: Float[Array, "*n 4"]) -> Float[Array, "*n 2 2"]:
    """The Cholesky factors of covariances, lower triangles, from what `Uncertainty.raw` says, in sizes of the face."""
    first, second = (jnp.exp(jnp.clip(raw[..., part], _SMALLEST, _LARGEST)) for part in (0, 1))
    # As large as the diagonal at most: the ellipse gets no thinner than float32 can say.
    slope = first * jnp.tanh(raw[..., 2])
    zero = jnp.zeros_like(first)
    return jnp.stack([jnp.stack([first, zero], -1), jnp.stack([slope, second], -1)], -2)


def scatters_of(raw: Float[Array, "*n 4"]) -> Float[Array, "*n 2 2"]:
    """The scatter matrices of the t distributions from what `Uncertainty.raw` says, in squares of the face's size."""
    factors = factors_of(raw)
    return jnp.einsum("...ij,...kj->...ik", factors, factors, precision=_EXACT)


def region_radius(share: float) -> float:
    """How far the region that holds this share of true landmarks reaches, in standard deviations of the covariances:
    of Student's t with ``FREEDOM`` degrees of freedom in two dimensions."""
    return math.sqrt((FREEDOM - 2) * ((1 - share) ** (-2 / FREEDOM) - 1))


def shape_of(landmarks: Landmarks) -> Landmarks:
    """The landmarks (L, 2) from their centroid, in sizes of the face."""
    return (landmarks - landmarks.mean(0)) / size_of(landmarks)


def size_of(landmarks: Landmarks) -> Scalar:
    """The size of a face that deviations are relative to: the root mean square distance of its landmarks from their
    centroid, in pixels, above 0."""
    offsets = landmarks - landmarks.mean(0)
    return jnp.sqrt(jnp.maximum(jnp.mean(jnp.sum(offsets**2, 1)), 1e-6))
