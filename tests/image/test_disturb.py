"""Disturbed pictures: points move with what they show, and amounts are what they are called."""

import cv2
import jax
import numpy as np
import pytest
from jax import numpy as jnp
from jax import random

from jaxfit.errors import InputError
from jaxfit.image import disturb
from jaxfit.image.disturb import Disturbance, Warp, covered, draw_warp, spoiled

NOTHING = Disturbance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # the others are nothing unless given
SIDE = 40
MIDDLE = jnp.full(2, (SIDE - 1) / 2)
KEYS = random.split(random.key(0), 400)


def blob(x: float, y: float) -> jax.Array:
    rows, columns = np.mgrid[:SIDE, :SIDE]
    return jnp.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8.0)


def centre_of_mass(picture: np.ndarray) -> np.ndarray:
    rows, columns = np.mgrid[:SIDE, :SIDE]
    return np.array([(columns * picture).sum(), (rows * picture).sum()]) / picture.sum()


@pytest.mark.parametrize("seed", range(5))
def test_points_stay_on_what_they_show(seed: int) -> None:
    warp = draw_warp(random.key(seed), Disturbance(rotation=0.3, log_scale=0.1, shear=0.1), MIDDLE)
    point = jnp.array([14.0, 23.0])
    moved = np.asarray(warp.points(point))
    assert np.linalg.norm(moved - point) > 0.2
    np.testing.assert_allclose(centre_of_mass(np.asarray(warp.picture(blob(*point)))), moved, atol=0.05)


def test_warps_are_affine_maps() -> None:
    turn = Warp(jnp.array([[0.0, 1.0], [-1.0, 0.0]]), MIDDLE)
    np.testing.assert_allclose(turn.picture(blob(10, 20)), np.rot90(blob(10, 20), -1), atol=1e-5)
    np.testing.assert_allclose(turn.points(MIDDLE), MIDDLE)


def test_amounts_are_standard_deviations() -> None:
    amounts = Disturbance(rotation=0.2, log_scale=0.1, shear=0.0)
    matrices = np.asarray(jax.vmap(lambda key: draw_warp(key, amounts, MIDDLE).matrix)(KEYS))
    np.testing.assert_allclose(np.std(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])), 0.2, rtol=0.1)
    np.testing.assert_allclose(np.std(np.log(np.linalg.det(matrices)) / 2), 0.1, rtol=0.1)


def test_nothing_changes_nothing() -> None:
    picture = 255 * blob(12, 30)
    warp = draw_warp(KEYS[0], NOTHING, MIDDLE)
    np.testing.assert_allclose(warp.picture(picture), picture, atol=1e-4)
    np.testing.assert_array_equal(spoiled(KEYS[0], picture, NOTHING), picture)


def some(**amounts: float) -> np.ndarray:
    """Spoiled pictures (400, 40, 40) of stripes."""
    picture = jnp.tile(jnp.array([60.0, 180.0]), (SIDE, SIDE // 2))
    wanted = Disturbance(**(vars(NOTHING) | amounts))
    return np.asarray(jax.vmap(lambda key: spoiled(key, picture, wanted))(KEYS))


def test_noise() -> None:
    pictures = some(noise=5.0)
    deviations = (pictures - np.tile([60.0, 180.0], SIDE // 2)).std((1, 2))
    # Half a normal distribution.
    np.testing.assert_allclose(deviations.mean(), 5 * np.sqrt(2 / np.pi), rtol=0.1)


def test_a_share_is_blurred_and_none_gets_brighter() -> None:
    pictures = some(blur=0.4)
    contrast = pictures[:, :, 2:-2].std((1, 2)) / 60
    assert 0.3 < (contrast < 0.999).mean() < 0.5
    assert contrast.min() < 0.05
    np.testing.assert_allclose(pictures.mean((1, 2)), 120, rtol=1e-3)


def test_a_share_is_partly_hidden() -> None:
    pictures = some(hidden=0.5)
    changed = (pictures != np.tile([60.0, 180.0], SIDE // 2)).mean((1, 2))
    assert 0.4 < (changed > 0).mean() < 0.6
    assert changed.max() < 0.3**2 + 0.05
    greys = [
        np.unique(picture[changed])
        for picture, changed in zip(pictures, pictures != np.tile([60.0, 180.0], SIDE // 2), strict=True)
    ]
    assert max(map(len, greys)) == 1


def test_a_share_is_covered_by_parts_of_another_picture() -> None:
    picture, other = jnp.zeros((SIDE, SIDE)), 100.0 + jnp.arange(SIDE * SIDE, dtype=jnp.float32).reshape(SIDE, SIDE)
    found = np.asarray(jax.vmap(lambda key: covered(key, picture, other, 0.5))(KEYS))
    changed = found != 0
    np.testing.assert_array_equal(found[changed], np.broadcast_to(other, found.shape)[changed])
    assert 0.4 < changed.any((1, 2)).mean() < 0.55
    assert changed.mean((1, 2)).max() < 0.5**2


def test_a_share_is_dark() -> None:
    light = some(dark=0.5).mean((1, 2)) / 120
    assert 0.4 < (light < 0.999).mean() < 0.6
    assert 0.1 <= light.min() < 0.2


def test_a_share_has_larger_pixels() -> None:
    """Stripes of a pixel are gone; the light, and slow changes, stay."""
    pictures = some(coarse=0.5)
    contrast = pictures[:, 8:-8, 8:-8].std((1, 2)) / 60
    assert 0.4 < (contrast < 0.999).mean() < 0.6
    assert contrast.min() < 0.3
    np.testing.assert_allclose(pictures.mean((1, 2)), 120, atol=8)
    slope = jnp.tile(jnp.arange(SIDE, dtype=jnp.float32), (SIDE, 1))
    amounts = Disturbance(**(vars(NOTHING) | {"coarse": 1.0}))
    found = np.asarray(jax.vmap(lambda key: spoiled(key, slope, amounts))(KEYS))
    np.testing.assert_allclose(found[:, :, 8:-8], np.broadcast_to(slope, found.shape)[:, :, 8:-8], atol=0.6)


@pytest.mark.parametrize("quality", [10, 30])
def test_compressed_pictures_are_those_of_a_jpeg_library(quality: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, columns = np.mgrid[:SIDE, :SIDE]
    picture = np.round(128 + 60 * np.sin(rows / 3) * np.cos(columns / 5) + 20 * (columns > 20)).astype(np.uint8)
    written = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    expected = cv2.imdecode(written, cv2.IMREAD_GRAYSCALE)
    monkeypatch.setattr(disturb, "_QUALITIES", (float(quality), float(quality)))
    amounts = Disturbance(**(vars(NOTHING) | {"compressed": 1.0}))
    found = np.asarray(spoiled(KEYS[0], jnp.asarray(picture, jnp.float32), amounts))
    assert np.abs(found - picture).mean() > 1
    assert np.abs(found - expected).mean() < 0.5


@pytest.mark.parametrize("wrong", [{"rotation": -0.1}, {"blur": 1.5}, {"hidden": np.nan}, {"noise": np.inf}])
def test_wrong_amounts(wrong: dict) -> None:
    with pytest.raises(InputError, match="expected numbers of at least 0"):
        Disturbance(**wrong)
