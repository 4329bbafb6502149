"""Histograms as vectors that do not depend on the picture's contrast; what is empty stays zero."""

from collections.abc import Callable
from math import sqrt

from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.errors import InputError
from jaxfit.types import Features

# Added to shares below a root, whose derivative is infinite at 0; a bin's mean share is 80 times as much.
_LEAST_SHARE = 1e-4


def unit_length(histograms: Float[Array, "cells bins"]) -> Features:
    """The histograms as one vector of Euclidean length 1 (Lowe)."""
    squared = jnp.sum(histograms**2)
    # Guarded before the root, too, whose derivative is infinite at 0.
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    return histograms.reshape(-1) / length


def unit_cells(histograms: Float[Array, "cells bins"]) -> Features:
    """The histograms as one vector in which each cell sums to 1 (thesis 3.1)."""
    total = histograms.sum(1, keepdims=True)
    return (histograms / jnp.where(total > 0, total, 1.0)).reshape(-1)


def unit_roots(histograms: Float[Array, "cells bins"]) -> Features:
    """Roots of the bins' shares of all, nearly of Euclidean length 1 (RootSIFT; Arandjelović and Zisserman, 2012).

    Strong edges drown weak ones less than in `unit_length`.
    """
    total = histograms.sum()
    shares = histograms.reshape(-1) / jnp.where(total > 0, total, 1.0)
    # The root less that of nothing, but exactly 0 where there is nothing.
    return shares / (jnp.sqrt(shares + _LEAST_SHARE) + sqrt(_LEAST_SHARE))


# What the command line and model files call them.
NORMALISATIONS: dict[str, Callable[[Float[Array, "cells bins"]], Features]] = {
    "cell": unit_cells,
    "root": unit_roots,
    "vector": unit_length,
}


def require_choices(orientation: str, orientations: tuple[str, ...], normalisation: str) -> None:
    """Check what a descriptor is asked for.

    Raises:
        InputError: it has no such orientation, or there is no such normalisation.
    """
    if orientation not in orientations or normalisation not in NORMALISATIONS:
        raise InputError(
            f"expected an orientation among {', '.join(orientations)}, and a normalisation among "
            f"{', '.join(NORMALISATIONS)}; got {orientation!r} and {normalisation!r}"
        )
