"""The dense descriptor against plain NumPy, and its laws: shifts, turns, contrast, flat pictures, derivatives."""

from functools import cache

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy import ndimage

from jaxfit.descriptors.dense import Dense
from jaxfit.descriptors.descriptor import Descriptor, describe_point
from jaxfit.errors import InputError

SIZE = 76
MIDDLE = (SIZE - 1) / 2
SMALL, LARGE = 12.0, 24.0  # windows that are looked up in the fine map, and in the coarse one


@cache
def describer(orientation="upright", normalisation="vector", zoom=1):
    dense = Dense(orientation, normalisation, zoom)
    return jax.jit(lambda crop, *where: describe_point(dense, dense.prepare(crop), *where))


def describe(crop, point=(MIDDLE, MIDDLE), side=SMALL, orientation="upright", angle=0.0, normalisation="vector"):
    where = np.float32(point), np.float32(side), np.float32(angle)
    return np.asarray(describer(orientation, normalisation)(crop, *where))


def textured(seed=0, low=0.0, high=255.0, sigma=2):
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(SIZE, SIZE)), sigma)
    return np.interp(noise, (noise.min(), noise.max()), (low, high)).astype(np.uint8)


def by_hand(crop, point, side, stride):
    """The definition, from angles and with SciPy's interpolation."""
    smoothed = crop.astype(float)
    for axis in (0, 1):
        smoothed = ndimage.correlate1d(smoothed, [1.0, 2.0, 1.0], axis)
    dx, dy = (ndimage.correlate1d(smoothed, [-1.0, 0.0, 1.0], axis)[2:-2, 2:-2] for axis in (1, 0))
    length, direction = np.hypot(dx, dy), np.arctan2(dy, dx)
    vector = np.zeros((16, 8))
    offsets = (np.arange(4) - 1.5) * side / 4
    for k in range(8):
        answer = length * np.maximum(0, np.cos(direction - k * np.pi / 4) - np.cos(np.pi / 4))
        count = (SIZE - 4) // stride
        squares = answer.reshape(count, stride, count, stride).sum((1, 3))
        # The first square's middle lies half a square beyond the margin of two pixels.
        y, x = ((centre + offsets - 1.5 - stride / 2) / stride for centre in (point[1], point[0]))
        at = np.stack(np.meshgrid(y, x, indexing="ij"))
        vector[:, k] = ndimage.map_coordinates(squares, at, order=1, mode="nearest").ravel()
    return vector.ravel() / np.linalg.norm(vector)


@pytest.mark.parametrize(("side", "stride"), [(SMALL, 2), (17.0, 2), (LARGE, 4)])
@pytest.mark.parametrize("point", [(MIDDLE, MIDDLE), (30.3, 44.8), (1.0, 73.0), (-20.0, 40.0)])
def test_is_its_definition(point, side, stride):
    crop = textured()
    np.testing.assert_allclose(describe(crop, point, side), by_hand(crop, point, side, stride), atol=2e-5)


@pytest.mark.parametrize(("zoom", "side", "shrunk"), [(2, LARGE, 1), (2, 40.0, 2), (4, 40.0, 2), (4, 90.0, 4)])
def test_zoomed_crops_are_seen_at_the_resolution_that_suits_the_window(zoom, side, shrunk):
    small = textured()[:48, :48]
    crop = np.repeat(np.repeat(small, shrunk, 0), shrunk, 1)[:144, :144]
    crop = np.pad(crop, ((0, -len(crop) % (4 * zoom)),) * 2, mode="edge")
    point = np.float32([60.2, 40.7])
    found = describer(zoom=zoom)(crop, point, np.float32(side), np.float32(0))
    pictures = crop.reshape(len(crop) // shrunk, shrunk, -1, shrunk).mean((1, 3)).astype(np.uint8)
    where = (point - (shrunk - 1) / 2) / shrunk, np.float32(side / shrunk), np.float32(0)
    usual = describer()(pictures, *where)
    np.testing.assert_allclose(found, usual, atol=2e-5)


@pytest.mark.parametrize("zoom", [0, 3, 16, True])
def test_other_zooms_are_refused(zoom):
    with pytest.raises(InputError, match="expected a zoom of 1, 2, 4, 8"):
        Dense(zoom=zoom)


def test_is_a_descriptor_of_vectors_of_length_one():
    assert isinstance(Dense(), Descriptor)
    vector = describe(textured())
    assert vector.shape == (Dense().size,)
    assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-5)
    assert (vector >= 0).all()


def test_roots_are_those_of_the_shares():
    vector, roots = describe(textured()), describe(textured(), normalisation="root")
    np.testing.assert_allclose(roots, np.sqrt(vector / vector.sum()), atol=0.011)
    assert np.linalg.norm(roots) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("orientation", ["upright", "face"])
@pytest.mark.parametrize("normalisation", ["cell", "root", "vector"])
@pytest.mark.parametrize("value", [0, 1, 200, 255])
def test_a_flat_picture_has_an_empty_descriptor(orientation, normalisation, value):
    crop = np.full((SIZE, SIZE), value, np.uint8)
    np.testing.assert_array_equal(describe(crop, (20.3, 40.1), 14.0, orientation, 0.3, normalisation), 0)


def test_contrast_and_brightness_do_not_matter():
    strong, weak = textured(), (textured(low=0, high=255) // 2 + 60).astype(np.uint8)
    assert describe(strong) @ describe(weak) > 0.99


@pytest.mark.parametrize("side", [SMALL, LARGE])
def test_moves_with_the_picture(side):
    crop, moved = textured(), np.roll(textured(), (4, 8), (0, 1))
    np.testing.assert_allclose(
        describe(moved, (MIDDLE + 8, MIDDLE + 4), side), describe(crop, (MIDDLE, MIDDLE), side), atol=1e-5
    )


@pytest.mark.parametrize("side", [SMALL, LARGE])
@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turned_windows_see_a_turned_picture_as_it_was(quarters, side):
    crop = textured()
    turned = np.rot90(crop, -quarters).copy()  # clockwise, as angles are
    seen = describe(turned, side=side, orientation="face", angle=quarters * np.pi / 2)
    np.testing.assert_allclose(seen, describe(crop, side=side, orientation="face"), atol=1e-4)
    assert np.abs(describe(turned, side=side) - describe(crop, side=side)).max() > 0.05


@pytest.mark.parametrize("degrees", [20.0, 45.0, -70.0])
def test_turned_windows_see_nearly_the_same_at_any_angle(degrees):
    crop = textured(sigma=4)
    x, y = np.meshgrid(np.arange(SIZE) - MIDDLE, np.arange(SIZE) - MIDDLE)
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    there = np.stack([cos * y - sin * x, cos * x + sin * y]) + MIDDLE
    turned = ndimage.map_coordinates(crop.astype(float), there, order=3, mode="nearest").clip(0, 255).astype(np.uint8)
    seen = describe(turned, side=LARGE, orientation="face", angle=np.radians(degrees))
    before = describe(crop, side=LARGE)
    # Between multiples of 45°, gradients are shared by more bins than before.
    assert seen @ before > 0.9
    assert seen @ before > describe(turned, side=LARGE) @ before + 0.05


@pytest.mark.parametrize(("orientation", "normalisation"), [("upright", "vector"), ("face", "root")])
def test_gradients_are_finite_and_alive(orientation, normalisation):
    dense = Dense(orientation, normalisation)
    weights = np.random.default_rng(0).normal(size=dense.size).astype(np.float32)
    gradients = jax.jit(jax.grad(lambda *inputs: describe_point(dense, *inputs) @ weights, (0, 1, 2, 3)))
    for crop in (textured(), np.full((SIZE, SIZE), 200, np.uint8)):
        prepared = dense.prepare(jnp.asarray(crop))
        (fine, coarse), point, side, angle = gradients(prepared, jnp.array([40.2, 37.7]), SMALL, jnp.float32(0.3))
        assert all(np.isfinite(gradient).all() for gradient in (fine, coarse, point, side, angle))
        assert np.any(point != 0) == np.any(side != 0) == (np.ptp(crop) > 0)
        assert np.any(angle != 0) == (np.ptp(crop) > 0 and orientation == "face")


def test_derivatives_are_those_of_finite_differences():
    dense, crop = Dense("face"), jnp.asarray(textured(sigma=4))
    weights = np.random.default_rng(0).normal(size=dense.size).astype(np.float32)
    value = jax.jit(lambda *where: describe_point(dense, dense.prepare(crop), *where) @ weights)
    where = np.float32([40.2, 37.7]), np.float32(13.0), np.float32(0.31)
    exact = jax.grad(value, (0, 1, 2))(*where)
    for number, step in ((0, np.float32([0.02, 0])), (0, np.float32([0, 0.02])), (1, 0.02), (2, 0.002)):
        ahead, behind = list(where), list(where)
        ahead[number], behind[number] = np.float32(where[number] + step), np.float32(where[number] - step)
        slope = (value(*ahead) - value(*behind)) / 2
        np.testing.assert_allclose(slope, np.sum(exact[number] * step), rtol=0.05, atol=2e-5)


@pytest.mark.parametrize("shape", [(74, 74), (76, 80)])
def test_crops_of_other_shapes_are_refused(shape):
    with pytest.raises(InputError, match=r"multiple of 4 pixels; got"):
        jax.eval_shape(Dense().prepare, jnp.zeros(shape, jnp.uint8))
