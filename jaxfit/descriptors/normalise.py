"""Histograms as vectors that do not depend on the picture's contrast; what is empty stays zero."""

from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.types import Features


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
