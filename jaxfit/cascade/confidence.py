"""How likely a fit is a good one, from what the cascade sees and does: clues of one face, and a small network."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.shapes.procrustes import align_similarity
from jaxfit.types import Features, Landmarks, Scalar

_EXACT = lax.Precision.HIGHEST
# Clues beside the sizes of the steps: shift along x and y, scale, rotation, change of shape, spread of the fits.
_BESIDE_STEPS = 6
_LEAST = 1e-3  # of the face, below which lengths do not differ: their logarithms stay finite


class Clues(NamedTuple):
    """What tells a good fit from a bad one; of a face, or of several with leading axes.

    Attributes:
        features: (F,) descriptors that the last step looked at: what stands at the landmarks.
        moves: (S + 6,) how the fit came about, free of scale; see `moves_of`.
    """

    features: Features
    moves: Float[Array, "moves"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Confidence:
    """The probability that a fit is good: a network of one hidden layer, in which PCA, whitening and calibration are
    folded.

    Attributes:
        seen: (F, H) weights of the descriptors.
        moved: (C, H) weights of the moves.
        biases: (H,) of the hidden units.
        output: (H,) weights of the hidden units.
        offset: () of the output.
    """

    seen: Float[Array, "features hidden"]
    moved: Float[Array, "moves hidden"]
    biases: Float[Array, "hidden"]
    output: Float[Array, "hidden"]
    offset: Float[Array, ""]

    def __call__(self, clues: Clues) -> Scalar:
        """The probability in [0, 1]."""
        return jax.nn.sigmoid(self.logit(clues))

    def logit(self, clues: Clues) -> Scalar:
        """The logarithm of its odds."""
        described = jnp.matmul(clues.features, self.seen, precision=_EXACT)
        moved = jnp.matmul(clues.moves, self.moved, precision=_EXACT)
        return jnp.dot(jnp.tanh(described + moved + self.biases), self.output, precision=_EXACT) + self.offset


def count_moves(steps: int) -> int:
    """How many moves `moves_of` tells of a cascade with so many steps."""
    return steps + _BESIDE_STEPS


def moves_of(path: Float[Array, "points landmarks 2"], others: Float[Array, "starts landmarks 2"]) -> Array:
    """How a fit came about, in units of the found face, whatever its size.

    Args:
        path: the landmarks at the start and after each of S steps, in pixels.
        others: the fits from all starts, with this one among them.

    Returns:
        (S + 6,): the logarithms of the size of each step; the shift of the face from its start in x and y, the
        logarithm of the scale and the rotation, in radians; the logarithms of how far the found shape is from that
        of the start, and of how far the other fits are, in their median.
    """
    start, found = path[0], path[-1]
    mean = start - start.mean(0)
    size = _size(found - found.mean(0))
    steps = jax.vmap(_size)(jnp.diff(path, axis=0)) / size
    moved = align_similarity(found, mean)
    shift = (moved.centre - start.mean(0)) / size
    # What no similarity explains: the power of the found face is that of the turned mean and of the rest.
    explained = moved.scale * _size(mean) / size
    shape = jnp.sqrt(jnp.maximum(1 - explained**2, 0.0))
    spread = jnp.median(jax.vmap(_size)(others - found)) / size
    lengths = jnp.stack([shape, spread])
    pose = jnp.stack([*shift, jnp.log(jnp.maximum(moved.scale, _LEAST)), moved.rotation])
    return jnp.concatenate([_logarithm(steps), pose, _logarithm(lengths)])


def _size(offsets: Landmarks) -> Scalar:
    """Root mean square length, above 0."""
    return jnp.sqrt(jnp.maximum(jnp.mean(jnp.sum(offsets**2, 1)), 1e-6))


def _logarithm(lengths: Float[Array, "lengths"]) -> Float[Array, "lengths"]:
    return jnp.log(lengths + _LEAST)
