"""The descriptor against a second one: plain loops in float64, written from the text of thesis 3.1 alone."""

import itertools
import math

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy import ndimage

from jaxfit.descriptors.descriptor import describe_point
from jaxfit.descriptors.sift import Sift, octant

CROP = 56
# How near, in bins, an orientation may be to the border of its bin before float32 may put it into the next one.
DOUBT = 1e-3


def smooth_noise(seed):
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(CROP, CROP)), 2, mode="wrap")
    return np.interp(noise, (noise.min(), noise.max()), (0, 255)).astype(np.uint8)


def gradients_around(smoothed, point, spacing, angle):
    """Central differences along the window's axes at its 32 × 32 samples, and the samples' Gaussian weights."""

    def value(u, v):
        x = point[0] + spacing * (u * math.cos(angle) - v * math.sin(angle))
        y = point[1] + spacing * (u * math.sin(angle) + v * math.cos(angle))
        return ndimage.map_coordinates(smoothed, [y, x], order=1, mode="nearest")

    u, v = np.meshgrid(np.arange(32) - 15.5, np.arange(32) - 15.5)
    weights = np.exp(-(u**2 + v**2) / (2 * 16**2))
    return value(u + 1, v) - value(u - 1, v), value(u, v + 1) - value(u, v - 1), weights


def reference(crop, point, side, orientation, normalisation, angle):
    """The descriptor, and for each of its numbers how much may go to a neighbouring bin by rounding."""
    smoothed = ndimage.gaussian_filter(crop.astype(np.float64), 1.6, mode="nearest")
    spacing = side / 32
    if orientation == "upright":
        angle = 0.0
    if orientation == "principal":
        dx, dy, weights = gradients_around(smoothed, point, spacing, 0.0)
        degrees = np.degrees(np.arctan2(dy, dx)) % 360
        histogram, _ = np.histogram(degrees, bins=36, range=(0, 360), weights=weights * np.hypot(dx, dy))
        first, second = np.sort(histogram)[[-1, -2]]
        assert second < 0.999 * first, "two peaks: this picture cannot test which one is taken"
        angle = math.radians(10 * np.argmax(histogram) + 5)

    dx, dy, weights = gradients_around(smoothed, point, spacing, angle)
    cells, doubtful = np.zeros((4, 4, 8)), np.zeros((4, 4, 8))
    for row, column in itertools.product(range(32), range(32)):
        x, y = dx[row, column], dy[row, column]
        amount = weights[row, column] * math.sqrt(x * x + y * y)
        turns = (math.atan2(y, x) % (2 * math.pi)) / (math.pi / 4)
        cells[row // 8, column // 8, int(turns) % 8] += amount
        if abs(turns - round(turns)) < DOUBT:
            doubtful[row // 8, column // 8, [round(turns) % 8, (round(turns) - 1) % 8]] += amount

    if normalisation == "cell":
        length = cells.sum(2, keepdims=True)
    else:
        length = np.full((1, 1, 1), math.sqrt((cells**2).sum()))
    length[length == 0] = 1
    return (cells / length).ravel(), (doubtful / length).ravel()


@pytest.mark.parametrize("normalisation", ["cell", "vector"])
@pytest.mark.parametrize("orientation", ["upright", "face", "principal"])
def test_agrees_with_the_reference(orientation, normalisation):
    sift = Sift(orientation, normalisation)
    describe = jax.jit(
        lambda crop, point, side: describe_point(sift, sift.prepare(crop), point, side, jnp.float32(0.7))
    )
    # Windows inside the picture: beyond its edge differences are exactly 0, and orientations on the border of bins.
    places = [((27.3, 29.6), 24.0), ((30.0, 26.0), 32.0), ((20.25, 33.5), 12.7), ((15.2, 40.9), 18.0)]
    for seed, (point, side) in enumerate(places):
        crop = smooth_noise(seed)
        found = np.asarray(describe(crop, np.float32(point), np.float32(side)))
        expected, doubt = reference(crop, np.float32(point).astype(float), side, orientation, normalisation, 0.7)
        assert (np.abs(found - expected) <= doubt + 1e-3).all(), (seed, np.abs(found - expected).max())


def test_octant_is_the_floor_of_the_angle():
    axes_and_diagonals = np.array(list(itertools.product([-1.0, -0.0, 0.0, 1.0], repeat=2)))
    random = np.random.default_rng(0).normal(size=(5000, 2))
    nearly_axes = np.array([[1, 1e-7], [1, -1e-7], [-1, 1e-7], [-1, -1e-7], [1e-7, 1], [-1e-7, -1]])
    x, y = np.concatenate([axes_and_diagonals, random, nearly_axes]).astype(np.float32).T
    # + 0.0 makes -0.0 a plain 0; eighths of a turn are exact in float64 where x and y are exact in float32.
    angles = np.arctan2(y.astype(np.float64) + 0.0, x.astype(np.float64) + 0.0) % (2 * math.pi)
    np.testing.assert_array_equal(octant(jnp.asarray(x), jnp.asarray(y)), np.floor(angles / (math.pi / 4)))
