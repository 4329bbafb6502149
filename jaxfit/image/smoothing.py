"""Gaussian smoothing (thesis 3.1), as two small matrix products."""

import numpy as np
from jax import lax
from jax import numpy as jnp

from jaxfit.types import Picture

SIGMA = 1.6  # pixels; thesis, 3.1
_TRUNCATE = 4.0  # standard deviations, as scipy.ndimage


def smoothing_matrix(size: int, sigma: float) -> np.ndarray:
    """The (size, size) matrix that smooths a line of ``size`` pixels, repeating the pixels at its ends."""
    radius = int(_TRUNCATE * sigma + 0.5)
    offsets = np.arange(-radius, radius + 1)
    kernel = np.exp(-0.5 * (offsets / sigma) ** 2)
    # Weights that are multiples of 2^-16 and sum to 1 are exact in float32 on whole numbers up to 255: what is flat
    # stays exactly flat. Descriptors do not know contrast and would otherwise describe the rounding there.
    kernel = np.round(kernel / kernel.sum() * 2**16) / 2**16
    kernel[radius] += 1 - kernel.sum()
    matrix = np.zeros((size, size), np.float32)
    rows = np.arange(size)
    for offset, weight in zip(offsets, kernel, strict=True):
        np.add.at(matrix, (rows, np.clip(rows + offset, 0, size - 1)), weight)
    return matrix


def smooth(picture: Picture, sigma: float = SIGMA) -> Picture:
    """Smooth a grey picture by a Gaussian of ``sigma`` pixels; edge pixels are repeated outside.

    For the small crops of this package two dense matrix products are faster than a separable convolution, on CPU and
    GPU alike.
    """
    height, width = picture.shape
    down = jnp.asarray(smoothing_matrix(height, sigma))
    across = jnp.asarray(smoothing_matrix(width, sigma))
    exact = lax.Precision.HIGHEST
    return jnp.matmul(jnp.matmul(down, picture, precision=exact), across.T, precision=exact)
