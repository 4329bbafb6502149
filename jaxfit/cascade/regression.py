"""Linear regression of steps from features: moments summed over batches, then PCA and least squares with intercept."""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
from jax import lax, vmap
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.exceptions import InputError
from jaxfit.types import Features, Scalar

_EXACT = lax.Precision.HIGHEST


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Moments:
    """Sums over samples of features x and targets y: all that least squares needs, whatever the number of samples.

    The features should be nearly centred, as a projection leaves them, lest their covariance drown in rounding.
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
            jnp.zeros(()),
            jnp.zeros(features),
            jnp.zeros(params),
            jnp.zeros((features, features)),
            jnp.zeros((features, params)),
        )

    def __add__(self, other: "Moments") -> "Moments":
        """Of the samples of both."""
        return jax.tree.map(jnp.add, self, other)

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


def principal_axes(features: Float[Array, "samples features"], variance: float) -> Projection:
    """PCA: the mean and as many axes as hold the share ``variance`` of the features' variance.

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
    return Projection(mean, axes)


class _Decomposed(NamedTuple):
    """Moments in the eigenbasis of the features' covariance, in which features are uncorrelated."""

    mean_x: Features
    mean_y: Float[Array, "params"]
    variances: Features
    axes: Float[Array, "features features"]
    cross: Float[Array, "features params"]


def _decomposed(moments: Moments) -> _Decomposed:
    mean_x = moments.x / moments.count
    mean_y = moments.y / moments.count
    covariance = moments.xx / moments.count - jnp.outer(mean_x, mean_x)
    cross = moments.xy / moments.count - jnp.outer(mean_x, mean_y)
    variances, axes = jnp.linalg.eigh(covariance)
    return _Decomposed(mean_x, mean_y, variances, axes, jnp.matmul(axes.T, cross, precision=_EXACT))


def _components(decomposed: _Decomposed, ridge: Scalar, variance: Scalar) -> Float[Array, "features params"]:
    """The weights in the eigenbasis: one problem a component, with a row √v · w = c / √v for the data, and a row
    √r · w = 0 for the ridge."""
    variances = decomposed.variances
    # Directions in which the samples do not differ carry no information: weight 0.
    known = variances > variances.shape[0] * jnp.finfo(variances.dtype).eps * variances[-1]
    # What the components from this one on hold, of those with less variance none.
    rest = jnp.cumsum(jnp.where(known, variances, 0.0))
    known &= rest > (1 - variance) * rest[-1]
    root = jnp.sqrt(jnp.where(known, variances, 1.0))
    strength = jnp.sqrt(ridge * jnp.mean(jnp.where(known, variances, 0.0)))
    data = jnp.where(known[:, None], decomposed.cross / root[:, None], 0.0)
    rows = jnp.stack([root, jnp.broadcast_to(strength, root.shape)], 1)[:, :, None]
    right = jnp.stack([data, jnp.zeros_like(data)], 1)
    return vmap(lambda a, b: jnp.linalg.lstsq(a, b)[0][0])(rows, right)


@jax.jit
def solve(
    moments: Moments, ridge: Float[Array, ""], variance: Float[Array, ""]
) -> tuple[Float[Array, "features params"], Float[Array, "params"]]:
    """Least squares of targets on features with an intercept, by ``jnp.linalg.lstsq``.

    In the eigenbasis of the features' covariance the features are uncorrelated, so that the tall problem falls apart
    into one problem a component with the same solution.

    Args:
        moments: of the samples.
        ridge: strength of the ridge penalty, relative to the mean variance of a feature given here: a kept component,
            when the features are projected. 0 is plain least squares.
        variance: share of the features' variance that the components hold that are used; 1 uses all.

    Returns:
        Weights and bias: ``step = features @ weights + bias``.
    """
    decomposed = _decomposed(moments)
    weights = jnp.matmul(decomposed.axes, _components(decomposed, ridge, variance), precision=_EXACT)
    return weights, decomposed.mean_y - jnp.matmul(decomposed.mean_x, weights, precision=_EXACT)


@jax.jit
def explained(
    seen: Moments,
    unseen: Moments,
    ridges: Float[Array, "choices"],
    variances: Float[Array, "choices"],
    effect: Float[Array, "params effects"],
) -> Float[Array, "choices"]:
    """By how much regressors solved on some samples reduce the sum of squares of others, for several choices at once.

    One decomposition serves all choices, and no sample is needed again: the sum of squares of what a regressor leaves
    is a quadratic form in the moments of the samples.

    Args:
        seen: of the samples to solve on.
        unseen: of the others.
        ridges: as `solve` has it, one a choice.
        variances: as `solve` has it, one a choice.
        effect: what is squared and summed is ``target @ effect``, as parameters differ in what they do.

    Returns:
        The sum of squares that predicting the mean of the samples solved on leaves, less what the regressor leaves.
    """
    decomposed = _decomposed(seen)
    x, y, axes = decomposed.mean_x, decomposed.mean_y, decomposed.axes
    # About the means of the samples solved on.
    xx = unseen.xx - jnp.outer(unseen.x, x) - jnp.outer(x, unseen.x) + unseen.count * jnp.outer(x, x)
    xy = unseen.xy - jnp.outer(unseen.x, y) - jnp.outer(x, unseen.y) + unseen.count * jnp.outer(x, y)
    xx = jnp.matmul(axes.T, jnp.matmul(xx, axes, precision=_EXACT), precision=_EXACT)
    xy = jnp.matmul(axes.T, jnp.matmul(xy, effect, precision=_EXACT), precision=_EXACT)

    def of_choice(choice: tuple[Scalar, Scalar]) -> Scalar:
        weights = jnp.matmul(_components(decomposed, *choice), effect, precision=_EXACT)
        return 2 * jnp.sum(weights * xy) - jnp.sum(weights * jnp.matmul(xx, weights, precision=_EXACT))

    return lax.map(of_choice, (ridges, variances))


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
