"""Aligning point sets by similarity transforms, and many of them to their common mean (generalised Procrustes)."""

from dataclasses import dataclass

import jax
from jax import lax, vmap
from jax import numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfit.shapes.space import Start
from jaxfit.types import Landmarks, Scalar

_EXACT = lax.Precision.HIGHEST


def align_similarity(points: Landmarks, mean: Landmarks) -> Start:
    """The centre, scale and rotation that carry ``mean`` (centroid at the origin) onto ``points`` in least squares."""
    centre = points.mean(0)
    offset = points - centre
    # With points as complex numbers, the best similarity is one complex factor: scale · exp(i · rotation).
    power = jnp.sum(mean**2)
    real = jnp.sum(offset * mean) / power
    imaginary = jnp.sum(mean[:, 0] * offset[:, 1] - mean[:, 1] * offset[:, 0]) / power
    # Coincident points have no rotation: a value of 0, and derivatives that are numbers.
    nowhere = (real == 0) & (imaginary == 0)
    real = jnp.where(nowhere, 1.0, real)
    scale = jnp.where(nowhere, 0.0, jnp.hypot(real, imaginary))
    return Start(centre, scale, jnp.arctan2(imaginary, real))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Procrustes:
    """Point sets brought together by generalised Procrustes analysis.

    Attributes:
        mean: (L, D) their mean: centroid at the origin, root mean square distance from it 1, turned as the sets are
            on average.
        aligned: (N, L, D) each set, moved, turned and scaled back from where the mean lies on it in least squares.
        rounds: how often the mean was taken.
        converged: whether the mean had come to rest.
    """

    mean: Float[Array, "landmarks dimensions"]
    aligned: Float[Array, "faces landmarks dimensions"]
    rounds: Int[Array, ""]
    converged: Bool[Array, ""]


@jax.jit
def generalised_procrustes(
    points: Float[Array, "faces landmarks dimensions"],
    tolerance: float | Scalar = 1e-6,
    most_rounds: int | Int[Array, ""] = 100,
) -> Procrustes:
    """Align N point sets, in 2D or 3D, to their common mean by translations, rotations and scales (thesis 3.2.1).

    Args:
        points: (N, L, D), in any unit.
        tolerance: the mean is at rest when a round moves it by less, in root mean square radii of the mean.
        most_rounds: after this many rounds the result is returned as it is, not ``converged``.
    """
    centred = points - points.mean(1, keepdims=True)
    radii = jnp.sqrt((centred**2).sum(2).mean(1))
    unit = centred / jnp.where(radii > 0, radii, 1.0)[:, None, None]

    def turned_onto(mean: Array) -> Float[Array, "faces landmarks dimensions"]:
        rotations = vmap(_best_rotation, (0, None))(unit, mean)
        turned = jnp.einsum("nld,nde->nle", unit, rotations, precision=_EXACT)
        # The size at which the mean lies on the set in least squares, as `align_similarity` has it.
        scales = jnp.sum(turned * mean, (1, 2)) / jnp.sum(mean**2)
        return turned / jnp.where(scales > 0, scales, 1.0)[:, None, None]

    def another(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        mean, _, rounds = state
        aligned = turned_onto(mean)
        new = _normalised(aligned.mean(0))
        return new, jnp.sqrt(jnp.mean(jnp.sum((new - mean) ** 2, 1))), rounds + 1

    first = (unit[0], jnp.array(jnp.inf, unit.dtype), jnp.array(0, jnp.int32))
    mean, moved, rounds = lax.while_loop(
        lambda state: (state[1] >= tolerance) & (state[2] < most_rounds), another, first
    )
    # The first set turned all others its way; turn the mean, instead, as the sets lie on average.
    mean = jnp.matmul(mean, _best_rotation(mean, unit.mean(0)), precision=_EXACT)
    return Procrustes(mean, turned_onto(mean), rounds, moved < tolerance)


def _best_rotation(
    points: Float[Array, "landmarks dimensions"], target: Float[Array, "landmarks dimensions"]
) -> Float[Array, "dimensions dimensions"]:
    """The rotation R, never a reflection, that brings ``points @ R`` nearest to ``target`` (Kabsch)."""
    left, _, right = jnp.linalg.svd(jnp.matmul(points.T, target, precision=_EXACT))
    sign = jnp.sign(jnp.linalg.det(jnp.matmul(left, right, precision=_EXACT)))
    return jnp.matmul(left * jnp.ones(len(left), left.dtype).at[-1].set(sign), right, precision=_EXACT)


def _normalised(points: Float[Array, "landmarks dimensions"]) -> Float[Array, "landmarks dimensions"]:
    centred = points - points.mean(0)
    return centred / jnp.sqrt(jnp.mean(jnp.sum(centred**2, 1)))
