"""Smoothing against scipy's, and what descriptors count on: a flat picture stays exactly flat."""

import jax
import numpy as np
import pytest
from scipy import ndimage

from jaxfit.image.smoothing import SIGMA, smooth, smoothing_matrix


@pytest.mark.parametrize("shape", [(40, 40), (17, 31), (5, 64)])  # the kernel is 13 pixels wide
def test_smooths_as_scipy_inside_and_at_the_edges(shape):
    picture = np.random.default_rng(0).uniform(0, 255, shape).astype(np.float32)
    expected = ndimage.gaussian_filter(picture.astype(np.float64), 1.6, mode="nearest")
    # Weights are multiples of 2^-16, 13 of them act on values up to 255, twice.
    np.testing.assert_allclose(jax.jit(smooth)(picture), expected, atol=2 * 13 * 255 * 2**-17)


@pytest.mark.parametrize("value", [0, 1, 77, 200, 255])
@pytest.mark.parametrize("size", [48, 63])
def test_a_flat_picture_stays_exactly_flat(value, size):
    picture = np.full((size, size), value, np.float32)
    np.testing.assert_array_equal(jax.jit(smooth)(picture), picture)


def test_rows_of_the_matrix_sum_to_one_and_are_positive():
    matrix = smoothing_matrix(30, SIGMA)
    np.testing.assert_array_equal(matrix.sum(1), 1)
    assert (matrix >= 0).all()
