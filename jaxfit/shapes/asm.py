"""The Active Shape Model (thesis 3.2.1): a mean, modes of variation, and the ellipsoid of likely faces; 2D and 3D."""

from dataclasses import dataclass

import jax
import numpy as np
import scipy
from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.errors import InputError

_EXACT = lax.Precision.HIGHEST
SIGMAS = 3.0  # the thesis's

Coefficients = Float[Array, "modes"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ActiveShapeModel:
    """Faces as a mean plus weighted modes, in 2D or 3D.

    Attributes:
        mean: (L, D) B₀, the mean face, its centroid at the origin, in pixels of the canonical face.
        modes: (M, L, D) B, orthonormal directions of variation, most variance first.
        deviations: (M,) σ, the standard deviation of each mode's coefficient, in the mean's unit.
    """

    mean: Float[Array, "landmarks dimensions"]
    modes: Float[Array, "modes landmarks dimensions"]
    deviations: Float[Array, "modes"]

    def reconstruct(self, b: Coefficients) -> Float[Array, "landmarks dimensions"]:
        """The face of coefficients b: B₀ + Σ bᵢ Bᵢ (Eq. 10)."""
        return self.mean + jnp.tensordot(b, self.modes, 1, precision=_EXACT)

    def scaled(self, factor: float | Float[Array, ""]) -> "ActiveShapeModel":
        """The same faces in another unit."""
        return ActiveShapeModel(self.mean * factor, self.modes, self.deviations * factor)

    def encode(self, aligned: Float[Array, "landmarks dimensions"]) -> Coefficients:
        """The coefficients nearest to a face that is aligned to the mean."""
        return jnp.tensordot(self.modes, aligned - self.mean, 2, precision=_EXACT)

    def restrict(self, b: Coefficients, sigmas: float | Float[Array, ""] = SIGMAS) -> Coefficients:
        """b, pulled straight back to the ellipsoid ‖b/σ‖ ≤ ``sigmas`` where it lies outside."""
        return b * restriction(b / self.deviations, sigmas)


def restriction(normalised: Coefficients, sigmas: float | Float[Array, ""]) -> Float[Array, ""]:
    """The factor, 1 or less, that brings coefficients in standard deviations into a ball."""
    squared = jnp.sum(normalised**2)
    # Outside alone, where the root has a derivative.
    outside = squared > sigmas**2
    return jnp.where(outside, sigmas / jnp.sqrt(jnp.where(outside, squared, 1.0)), 1.0)


def likely_radius(modes: int) -> float:
    """The radius of the ellipsoid of ``modes`` dimensions that holds what ±3 σ hold in one: 99.7 % of normal faces."""
    chi2 = scipy.stats.chi2  # SciPy imports this, which takes long, when it is asked for
    return float(np.sqrt(chi2.ppf(chi2.cdf(SIGMAS**2, 1), modes)))


def learn_shape_model(aligned: Float[Array, "faces landmarks dimensions"], variance: float) -> ActiveShapeModel:
    """PCA of aligned faces (Eq. 9), keeping as many modes as hold the share ``variance`` of their variance.

    Args:
        aligned: (N, L, D) faces, aligned to one another; their unit becomes the model's.
        variance: share to keep, in (0, 1].

    Raises:
        InputError: ``variance`` is not in (0, 1], or all faces are equal.
    """
    if not 0 < variance <= 1:
        raise InputError(f"expected a share of the shape's variance to keep, 0 < variance <= 1; got {variance}")
    mean = aligned.mean(0)
    centred = (aligned - mean).reshape(len(aligned), -1)
    _, singular, axes = jnp.linalg.svd(centred, full_matrices=False)
    variances = singular**2 / len(aligned)
    # What rounding leaves is no variation.
    reliable = int(jnp.sum(singular > max(centred.shape) * jnp.finfo(centred.dtype).eps * jnp.abs(aligned).max()))
    if not reliable:
        raise InputError("all faces have the same shape: no shape model can be learned from them")
    held = jnp.cumsum(variances)
    kept = min(reliable, int(jnp.searchsorted(held, variance * held[-1])) + 1)
    return ActiveShapeModel(mean, axes[:kept].reshape(kept, *mean.shape), jnp.sqrt(variances[:kept]))
