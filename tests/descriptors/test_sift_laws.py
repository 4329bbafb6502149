"""What descriptors are and are not invariant to, their normalisation, and gradients where pictures are flat."""

from functools import cache

import jax
import jaxtyping
import numpy as np
import pytest
from jax import numpy as jnp
from scipy import ndimage

from jaxfit.descriptors.descriptor import describe_point
from jaxfit.descriptors.sift import Prepared, Sift, _sums_of_cells
from jaxfit.errors import InputError
from jaxfit.image.sampling import pack

SIZE = 80
MIDDLE = (SIZE - 1) / 2
OPTIONS = [(o, n) for o in ("upright", "face", "principal") for n in ("cell", "root", "vector")]


@cache
def describer(orientation="upright", normalisation="cell"):
    """Descriptor of a uint8 crop."""
    sift = Sift(orientation, normalisation)
    return jax.jit(lambda crop, point, side, angle: describe_point(sift, sift.prepare(crop), point, side, angle))


@cache
def plain_describer(orientation):
    """Descriptor of a picture that is taken as it is, not smoothed."""
    sift = Sift(orientation, "cell")
    return jax.jit(lambda picture, *where: describe_point(sift, Prepared(picture, pack(picture)), *where))


def describe(crop, point=(MIDDLE, MIDDLE), side=24.0, orientation="upright", normalisation="cell", angle=0.0):
    where = np.float32(point), np.float32(side), np.float32(angle)
    return np.asarray(describer(orientation, normalisation)(crop, *where))


def textured(seed=0, low=0, high=255):
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(SIZE, SIZE)), 2)
    return np.interp(noise, (noise.min(), noise.max()), (low, high)).astype(np.uint8)


def half_flat():
    crop = textured()
    crop[:, 32:] = 200
    return crop


def moved(a, b):
    """Share of the descriptor that lies in other bins: 0 for equal descriptors, 1 for disjoint ones."""
    return np.abs(a - b).sum() / (a.sum() + b.sum())


def waves(x, y):
    """A smooth pattern without symmetries and with one prevailing direction of slope."""
    rng = np.random.default_rng(0)
    directions, phases = 0.22 * rng.normal(size=(8, 2)), rng.uniform(0, 2 * np.pi, 8)
    pattern = sum(np.sin(a * x + b * y + phase) for (a, b), phase in zip(directions, phases, strict=True))
    return 128 + 15 * pattern + 6.6 * (x * np.cos(0.6) + y * np.sin(0.6))


def wave_descriptor(orientation, degrees=0.0, scale=1.0, side=32.0, angle=0.0):
    """Descriptor of the pattern rotated clockwise and enlarged about the landmark, ``angle`` in degrees."""
    x, y = np.meshgrid(np.arange(SIZE) - MIDDLE, np.arange(SIZE) - MIDDLE)
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    picture = waves((cos * x + sin * y) / scale, (cos * y - sin * x) / scale).astype(np.float32)
    middle = jnp.array([MIDDLE, MIDDLE])
    return np.asarray(plain_describer(orientation)(picture, middle, jnp.float32(side), jnp.radians(angle)))


@pytest.mark.parametrize("orientation", ["upright", "face", "principal"])
def test_each_cell_sums_to_one_or_is_empty(orientation):
    assert describe(textured(), orientation=orientation).reshape(16, 8).sum(1) == pytest.approx(1, abs=1e-5)
    sums = describe(half_flat(), orientation=orientation).reshape(16, 8).sum(1)
    assert {*sums.round(5)} == {0.0, 1.0}


@pytest.mark.parametrize("orientation", ["upright", "face", "principal"])
def test_the_whole_vector_has_length_one(orientation):
    vector = describe(textured(), orientation=orientation, normalisation="vector")
    assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-5)
    assert (vector >= 0).all()


@pytest.mark.parametrize(("orientation", "normalisation"), OPTIONS)
@pytest.mark.parametrize("point", [(MIDDLE, MIDDLE), (2.3, 76.1), (-50.0, 200.0)])
def test_a_flat_picture_has_an_empty_descriptor(orientation, normalisation, point):
    for value in (0, 1, 77, 200, 255):
        crop = np.full((SIZE, SIZE), value, np.uint8)
        np.testing.assert_array_equal(describe(crop, point, 24, orientation, normalisation), 0)


def test_what_a_sample_adds_to_its_cell_and_bin_is_all_that_it_adds():
    """The sums have a rule of their own for gradients."""
    rng = np.random.default_rng(0)
    weights, bins = rng.normal(size=(4, 4, 8)).astype(np.float32), rng.integers(0, 8, (32, 32)).astype(np.int32)
    row, column = np.indices((32, 32)) // 8
    slopes = jax.grad(lambda samples: jnp.sum(weights.reshape(16, 8) * _sums_of_cells(samples, jnp.asarray(bins))))(
        jnp.zeros((32, 32))
    )
    np.testing.assert_array_equal(slopes, weights[row, column, bins])


SOME_OPTIONS = [("upright", "cell"), ("principal", "vector"), ("face", "root")]


@pytest.mark.parametrize(("orientation", "normalisation"), SOME_OPTIONS)
def test_gradients_are_finite_and_alive(orientation, normalisation):
    sift = Sift(orientation, normalisation)
    weights = np.random.default_rng(0).normal(size=sift.size).astype(np.float32)
    # Compiled without optimisation, which would take twice as long and changes nothing here.
    gradient = jax.grad(lambda *inputs: describe_point(sift, *inputs) @ weights, (0, 1, 2, 3))
    gradients = jax.jit(gradient, compiler_options={"xla_backend_optimization_level": 0})
    for crop in (textured(), half_flat(), np.full((SIZE, SIZE), 200, np.uint8), np.zeros((SIZE, SIZE), np.uint8)):
        prepared = sift.prepare(jnp.asarray(crop))
        picture, *where = gradients(prepared, jnp.array([MIDDLE, MIDDLE]), jnp.float32(24), jnp.float32(0.3))
        assert all(np.isfinite(gradient).all() for gradient in jax.tree.leaves((picture, where)))
        point, side, angle = where
        seen = picture.smoothed if picture.packed is None else picture.smoothed + picture.packed.sum(2)
        assert all(np.any(gradient != 0) == (np.ptp(crop) > 0) for gradient in (seen, point, side))
        assert np.any(angle != 0) == (np.ptp(crop) > 0 and orientation == "face")


@pytest.mark.parametrize("normalisation", ["cell", "vector"])
def test_contrast_and_brightness_do_not_matter(normalisation):
    crop = textured(high=120)
    options = {"orientation": "principal", "normalisation": normalisation}
    np.testing.assert_allclose(describe(2 * crop + 10, **options), describe(crop, **options), atol=1e-3)


@pytest.mark.parametrize("orientation", ["upright", "face", "principal"])
def test_moves_with_the_picture(orientation):
    crop = textured()
    moved_crop = np.roll(crop, (3, -5), (0, 1))  # rows, columns; the window and what smooths it lie inside
    expected = describe(crop, (40.25, 38.5), orientation=orientation)
    np.testing.assert_allclose(describe(moved_crop, (35.25, 41.5), orientation=orientation), expected, atol=1e-3)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_quarter_turns_keep_the_principal_descriptor_and_change_the_upright_one(quarters):
    # The sampling grid is mapped onto itself, and 90° are nine bins of 10°: nothing is approximate here.
    crop = textured()
    turned = np.rot90(crop, quarters).copy()
    assert moved(describe(turned, orientation="principal"), describe(crop, orientation="principal")) < 1e-3
    assert moved(describe(turned), describe(crop)) > 0.3


@pytest.mark.parametrize("degrees", [10, 17, 43, 60, 77, 110, 135, 222, 300])
def test_turns_keep_the_principal_descriptor_and_change_the_upright_one(degrees):
    principal = moved(wave_descriptor("principal", degrees), wave_descriptor("principal"))
    upright = moved(wave_descriptor("upright", degrees), wave_descriptor("upright"))
    # The principal orientation is the centre of a bin of 10°. After other turns than multiples of 10° the window is
    # off by a part of a bin, at most by 10°: no worse than an upright window when the picture turns by 10°.
    one_bin = moved(wave_descriptor("upright", 10), wave_descriptor("upright"))
    assert principal < (0.03 if degrees % 10 == 0 else one_bin)
    assert degrees == 10 or upright > 1.4 * one_bin


@pytest.mark.parametrize("degrees", [10, 45, 90, 217])
def test_a_window_that_turns_with_the_face_sees_it_upright(degrees):
    expected = wave_descriptor("upright")
    assert moved(wave_descriptor("face", degrees, angle=degrees), expected) < 0.03
    assert moved(wave_descriptor("face", degrees), expected) > 0.2


@pytest.mark.parametrize("scale", [0.5, 1.5, 2.0])
def test_a_larger_picture_in_a_larger_window_is_the_same(scale):
    expected = wave_descriptor("upright", side=32)
    # What is left comes from interpolating between the pixels of the smaller picture.
    assert moved(wave_descriptor("upright", scale=scale, side=32 * scale), expected) < 0.06
    assert moved(wave_descriptor("upright", scale=scale, side=32), expected) > 0.15


@pytest.mark.parametrize("options", [("sideways", "cell"), ("upright", "none"), ("cell", "upright")])
def test_unknown_options_are_refused(options, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # which would refuse them first
    with pytest.raises(InputError, match="expected an orientation among upright, face, principal"):
        Sift(*options)
