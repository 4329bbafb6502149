"""Linear regression of steps from features: moments summed over batches, then PCA and least squares with intercept."""

from dataclasses import dataclass
from functools import partial

import jax
from jax import lax, vmap
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.errors import InputError
from jaxfit.types import Features, Scalar

_EXACT = lax.Precision.HIGHEST


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Moments:
    """Sums over samples of features x and targets y: all that least squares needs, whatever the number of samples.

    The features should be nearly centred, as a projection leaves them; otherwise their covariance drowns in rounding.
    """

    count: Scalar
    x: Features
    y: Float[Array, "params"]
    xx: Float[Array, "features features"]
    xy: Float[Array, "features params"]

    @staticmethod
    def empty(features: int, params: int) -> "Moments":
        """No samples yet, for vectors of these sizes."""
        return Moments(
            jnp.zeros((), jnp.float32),
            jnp.zeros(features, jnp.float32),
            jnp.zeros(params, jnp.float32),
            jnp.zeros((features, features), jnp.float32),
            jnp.zeros((features, params), jnp.float32),
        )

    def add(
        self,
        features: Float[Array, "samples features"],
        targets: Float[Array, "samples params"],
        weights: Float[Array, "samples"],
    ) -> "Moments":
        """With more samples; weight 0 leaves one out."""
        x = features * weights[:, None]
        y = targets * weights[:, None]
        return Moments(
            self.count + weights.sum(),
            self.x + x.sum(0),
            self.y + y.sum(0),
            # Weights are 0 or 1, so weighting both factors weights once.
            self.xx + jnp.matmul(x.T, x, precision=_EXACT),
            self.xy + jnp.matmul(x.T, y, precision=_EXACT),
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Projection:
    """Principal axes of the features: ``(features - mean) @ axes``.

    Attributes:
        mean: (F,) mean of the features.
        axes: (F, K) orthonormal axes, most variance first.
    """

    mean: Features
    axes: Float[Array, "features kept"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spectrum:
    """Principal axes, and what they hold.

    Attributes:
        projection: on all K axes.
        held: (K,) share of the features' variance that the first axis holds, the first two, and so on.
    """

    projection: Projection
    held: Float[Array, "kept"]

    def keeping(self, variance: float) -> Projection:
        """As many of the axes as hold the share ``variance`` of the features' variance, all if they hold less."""
        kept = int(jnp.searchsorted(self.held, variance)) + 1
        return Projection(self.projection.mean, self.projection.axes[:, :kept])


def principal_axes(features: Float[Array, "samples features"], variance: float) -> Projection:
    """PCA: the mean and as many axes as hold the share ``variance`` of the features' variance.

    Raises:
        InputError: as `spectrum`.
    """
    return spectrum(features, variance).projection


def spectrum(features: Float[Array, "samples features"], variance: float) -> Spectrum:
    """PCA: as many axes as hold the share ``variance`` of the features' variance, and what the first of them hold.

    Raises:
        InputError: ``variance`` is not in (0, 1], or all samples are equal.
    """
    if not 0 < variance <= 1:
        raise InputError(f"expected a share of variance to keep, 0 < variance <= 1; got {variance}")
    mean = features.mean(0)
    centred = features - mean
    # Samples × samples and features × features have the same spectrum: decompose the smaller.
    few = centred.shape[0] < centred.shape[1]
    gram = jnp.matmul(centred, centred.T, precision=_EXACT) if few else jnp.matmul(centred.T, centred, precision=_EXACT)
    variances, vectors = jnp.linalg.eigh(gram)
    variances, vectors = variances[::-1], vectors[:, ::-1]
    reliable = int(jnp.sum(variances > max(centred.shape) * jnp.finfo(gram.dtype).eps * variances[0]))
    # The mean of equal numbers may be rounded, which leaves a little variance.
    if not reliable or bool((features == features[0]).all()):
        raise InputError("the features of all samples are equal: nothing can be learned from these pictures")
    held = jnp.cumsum(jnp.maximum(variances, 0))
    kept = min(reliable, int(jnp.searchsorted(held, variance * held[-1])) + 1)
    axes = vectors[:, :kept]
    if few:
        axes = jnp.matmul(centred.T, axes, precision=_EXACT) / jnp.sqrt(variances[:kept])
    return Spectrum(Projection(mean, axes), held[:kept] / held[-1])


@jax.jit
def solve(moments: Moments, ridge: Float[Array, ""]) -> tuple[Float[Array, "features params"], Float[Array, "params"]]:
    """Least squares of targets on features with an intercept, by ``jnp.linalg.lstsq``.

    In the eigenbasis of the features' covariance the features are uncorrelated, so that the tall problem falls apart
    into one problem a component with the same solution: a row √v · w = c / √v for the data, and a row √r · w = 0 for
    the ridge.

    Args:
        moments: of the samples.
        ridge: strength of the ridge penalty, relative to the mean variance of a feature given here: a kept component,
            when the features are projected. 0 is plain least squares.

    Returns:
        Weights and bias: ``step = features @ weights + bias``.
    """
    mean_x = moments.x / moments.count
    mean_y = moments.y / moments.count
    covariance = moments.xx / moments.count - jnp.outer(mean_x, mean_x)
    cross = moments.xy / moments.count - jnp.outer(mean_x, mean_y)
    variances, axes = jnp.linalg.eigh(covariance)
    # Directions in which the samples do not differ carry no information: weight 0.
    known = variances > variances.shape[0] * jnp.finfo(variances.dtype).eps * variances[-1]
    root = jnp.sqrt(jnp.where(known, variances, 1.0))
    strength = jnp.sqrt(ridge * jnp.mean(jnp.where(known, variances, 0.0)))
    data = jnp.where(known[:, None], jnp.matmul(axes.T, cross, precision=_EXACT) / root[:, None], 0.0)
    rows = jnp.stack([root, jnp.broadcast_to(strength, root.shape)], 1)[:, :, None]
    right = jnp.stack([data, jnp.zeros_like(data)], 1)
    components = vmap(lambda a, b: jnp.linalg.lstsq(a, b)[0][0])(rows, right)
    weights = jnp.matmul(axes, components, precision=_EXACT)
    return weights, mean_y - jnp.matmul(mean_x, weights, precision=_EXACT)


@partial(jax.jit, static_argnames="rank")
def main_directions(
    moments: Moments, weights: Float[Array, "features params"], rank: int
) -> Float[Array, "rank params"]:
    """The orthonormal directions in which what ``weights`` predict for the samples varies most.

    Regressing along these alone is reduced-rank regression (Izenman 1975) with all parameters weighted alike.
    """
    mean = moments.x / moments.count
    covariance = moments.xx / moments.count - jnp.outer(mean, mean)
    predicted = jnp.matmul(weights.T, jnp.matmul(covariance, weights, precision=_EXACT), precision=_EXACT)
    return jnp.linalg.eigh(predicted)[1][:, ::-1][:, :rank].T
