"""Other pictures of the same face, to learn from: warped, blurred, noisy, dark, coarse, compressed or partly hidden."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jax import lax, random
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.errors import InputError
from jaxfit.image.sampling import bilinear, pack
from jaxfit.types import Crop, Picture, Point, Scalar

_BLURS = 4  # times [1 2 1] in both directions, at most
_GRAIN = 256  # side of the pattern that all noise is cut from, in pixels
_HIDDEN_SIDES = (0.07, 0.3)  # of what hides a part, in sides of the picture
_SHARES = ("blur", "hidden", "covered", "dark", "coarse", "compressed")
_COVER_SIDES = (0.08, 0.5)  # of what covers a part, in sides of the picture
_DARKEST = 0.1  # of a picture's light
_COARSEST = 4.0  # pixels whose place one takes
_BLOCK = 8  # side of JPEG's blocks, in pixels
_QUALITIES = (5.0, 60.0)  # of JPEG
_LUMINANCE = (
    (16, 11, 10, 16, 24, 40, 51, 61),
    (12, 12, 14, 19, 26, 58, 60, 55),
    (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62),
    (18, 22, 37, 56, 68, 109, 103, 77),
    (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101),
    (72, 92, 95, 98, 112, 100, 103, 99),
)


@dataclass(frozen=True)
class Disturbance:
    """By how much pictures are changed; with 0 everywhere they stay what they are.

    Attributes:
        rotation: standard deviation, in radians.
        log_scale: standard deviation of the logarithm of the scale.
        shear: standard deviation of the shift of a line of pixels against the next one, in pixels.
        blur: share of the pictures that are blurred, each by another amount.
        noise: standard deviation of how much noise a picture gets, in grey values.
        hidden: share of the pictures in which a rectangle of one grey hides a part.
        covered: share of the pictures in which a part of another picture, with round corners, lies over a part.
        dark: share of the pictures that are dark, down to a tenth of their light, each by another amount.
        coarse: share of the pictures whose pixels are larger, up to four times, each by another factor.
        compressed: share of the pictures that have been compressed as JPEG does it, from mildly to badly.

    Raises:
        InputError: a number is below 0, or a share above 1.
    """

    rotation: float = 0.15
    log_scale: float = 0.06
    shear: float = 0.05
    blur: float = 0.3
    noise: float = 2.0
    hidden: float = 0.2
    covered: float = 0.0
    dark: float = 0.0
    coarse: float = 0.0
    compressed: float = 0.0

    def __post_init__(self) -> None:
        values = vars(self).values()
        shares = {name: getattr(self, name) for name in _SHARES}
        if not (all(map(math.isfinite, values)) and min(values) >= 0 and max(shares.values()) <= 1):
            raise InputError(
                f"expected numbers of at least 0, and shares ({', '.join(shares)}) of at most 1; got {self}"
            )


class Warp(NamedTuple):
    """An affine map of a picture about a point.

    Attributes:
        matrix: (2, 2) from offsets in the new picture to offsets in the old one.
        about: the point, which stays where it is.
    """

    matrix: Float[Array, "2 2"]
    about: Point

    def points(self, points: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        """Where points of the old picture are in the new one."""
        return jnp.matmul(points - self.about, jnp.linalg.inv(self.matrix).T) + self.about

    def picture(self, picture: Picture) -> Picture:
        """The new picture; beyond the old one its edge is repeated."""
        height, width = picture.shape
        kind = picture.dtype
        x, y = jnp.meshgrid(
            jnp.arange(width, dtype=kind) - self.about[0], jnp.arange(height, dtype=kind) - self.about[1]
        )
        matrix = self.matrix
        return bilinear(
            pack(picture),
            matrix[0, 0] * x + matrix[0, 1] * y + self.about[0],
            matrix[1, 0] * x + matrix[1, 1] * y + self.about[1],
        )


def draw_warp(key: Array, amounts: Disturbance, about: Point) -> Warp:
    """A random rotation, scale and shear about a point."""
    turn, grow, lean = random.normal(key, (3,), jnp.float32)
    angle, shear = amounts.rotation * turn, amounts.shear * lean
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    turned = jnp.array([[cos, -sin], [sin, cos]])
    sheared = jnp.array([[1.0, shear], [0.0, 1.0]])
    return Warp(jnp.matmul(turned, sheared) * jnp.exp(amounts.log_scale * grow), about)


def disturbed(key: Array, crop: Crop, amounts: Disturbance, other: Crop | None = None) -> tuple[Crop, Warp]:
    """A crop (H, H) warped about its middle, and spoiled; and how it was warped.

    ``other`` is a crop of another picture, parts of which may cover this one; None: nothing does.
    """
    of_warp, of_picture = random.split(key)
    warp = draw_warp(of_warp, amounts, jnp.full(2, (len(crop) - 1) / 2, jnp.float32))
    picture = warp.picture(crop.astype(jnp.float32))
    if amounts.covered and other is not None:
        picture = covered(random.fold_in(of_picture, 1), picture, other.astype(jnp.float32), amounts.covered)
    picture = spoiled(of_picture, picture, amounts)
    return jnp.clip(jnp.round(picture), 0, 255).astype(jnp.uint8), warp


def covered(key: Array, picture: Picture, other: Picture, share: float) -> Picture:
    """A picture, or one in which a part of another lies anywhere, in any direction: hands, hair, bars, other faces."""
    height, width = picture.shape
    centre, sides, (angle, whether) = (random.uniform(part, (2,), jnp.float32) for part in random.split(key, 3))
    low, high = _COVER_SIDES
    half = height * (low + (high - low) * sides) / 2
    x, y = jnp.meshgrid(
        jnp.arange(width, dtype=picture.dtype) - width * centre[0],
        jnp.arange(height, dtype=picture.dtype) - height * centre[1],
    )
    cos, sin = jnp.cos(jnp.pi * angle), jnp.sin(jnp.pi * angle)
    inside = ((cos * x + sin * y) / half[0]) ** 4 + ((cos * y - sin * x) / half[1]) ** 4 < 1
    return jnp.where(inside & (whether < share), other, picture)


def spoiled(key: Array, picture: Picture, amounts: Disturbance) -> Picture:
    """A picture, in grey values, that is coarse, dark, blurred, noisy, partly hidden or compressed, or not, as chance
    will have it."""
    of_blur, of_noise, of_hidden = random.split(key, 3)
    if amounts.coarse:
        picture = _coarse(random.fold_in(key, 1), picture, amounts.coarse)
    if amounts.dark:
        light, whether = random.uniform(random.fold_in(key, 2), (2,), jnp.float32)
        # Whole grey values, as a camera stores them: what is lost in the dark.
        picture = jnp.where(whether < amounts.dark, jnp.round((_DARKEST + (1 - _DARKEST) * light) * picture), picture)
    if amounts.blur:
        picture = _blurred(of_blur, picture, amounts.blur)
    if amounts.noise:
        strength, pattern = random.split(of_noise)
        deviation = amounts.noise * jnp.abs(random.normal(strength, (), jnp.float32))
        picture = picture + deviation * _grain(pattern, *picture.shape)
    if amounts.hidden:
        picture = _partly_hidden(of_hidden, picture, amounts.hidden)
    return _compressed(random.fold_in(key, 3), picture, amounts.compressed) if amounts.compressed else picture


def _coarse(key: Array, picture: Picture, share: float) -> Picture:
    """As a camera sees a face that has fewer pixels, enlarged again."""
    amount, whether = random.uniform(key, (2,), jnp.float32)
    factor = jnp.where(whether < share, 1 + (_COARSEST - 1) * amount, 1.0)

    def along(size: int) -> Float[Array, "size size"]:
        pixels = jnp.arange(size, dtype=picture.dtype)
        large = (pixels + 0.5) * factor - 0.5  # where the large pixels are; those beyond the picture are not used
        # Linear between large pixels; each is the mean of what it covers.
        between = jnp.maximum(1 - jnp.abs(pixels[:, None] - large) / factor, 0.0)
        covers = jnp.clip((factor + 1) / 2 - jnp.abs(large[:, None] - pixels), 0.0, 1.0)
        within = large[:, None] < size - 1 + factor / 2
        covers = jnp.where(within, covers, 0.0)
        between = between * within[:, 0]
        of_pixels = jnp.matmul(
            between / jnp.maximum(between.sum(1, keepdims=True), 1e-6),
            covers / jnp.maximum(covers.sum(1, keepdims=True), 1e-6),
        )
        return jnp.where(factor > 1, of_pixels, jnp.eye(size, dtype=picture.dtype))

    down, across = (along(size) for size in picture.shape)
    return jnp.matmul(down, jnp.matmul(picture, across.T))


def _compressed(key: Array, picture: Picture, share: float) -> Picture:
    """As JPEG (ITU-T T.81, Annex K's table for luminance) leaves it, at a quality between bad and fair."""
    amount, whether = random.uniform(key, (2,), jnp.float32)
    low, high = _QUALITIES
    quality = low + (high - low) * amount
    factor = jnp.where(quality < 50, 50 / quality, 2 - quality / 50)
    table = jnp.maximum(jnp.asarray(_LUMINANCE, picture.dtype) * factor, 1.0)
    height, width = picture.shape
    pad = [(0, -size % _BLOCK) for size in picture.shape]
    blocks = jnp.pad(picture - 128, pad, mode="edge")
    rows, columns = blocks.shape[0] // _BLOCK, blocks.shape[1] // _BLOCK
    blocks = blocks.reshape(rows, _BLOCK, columns, _BLOCK)
    frequency = np.arange(_BLOCK)[:, None] * (2 * np.arange(_BLOCK) + 1) * np.pi / (2 * _BLOCK)
    cosines = np.cos(frequency) * np.where(np.arange(_BLOCK)[:, None] == 0, np.sqrt(1 / 8), 0.5)
    transform = jnp.asarray(cosines, picture.dtype)
    waves = jnp.einsum("ui,rick,vk->rucv", transform, blocks, transform)
    waves = jnp.round(waves / table[:, None]) * table[:, None]
    found = jnp.einsum("ui,rucv,vk->rick", transform, waves, transform)
    found = found.reshape(rows * _BLOCK, columns * _BLOCK)[:height, :width] + 128
    return jnp.where(whether < share, found, picture)


def _blurred(key: Array, picture: Picture, share: float) -> Picture:
    amount, whether = random.uniform(key, (2,), jnp.float32)
    times = jnp.where(whether < share, _BLURS * amount, 0.0)
    for done in range(_BLURS):
        # One after the other: otherwise what leads to a pixel is computed again for each of its neighbours.
        picture = lax.optimization_barrier(picture)
        picture = picture + jnp.clip(times - done, 0.0, 1.0) * (_smoothed(picture) - picture)
    return picture


def _smoothed(picture: Picture) -> Picture:
    """By [1 2 1] in both directions; edge pixels are repeated outside."""
    padded = jnp.pad(picture, 1, mode="edge")
    down = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    return (down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]) / 4


def _grain(key: Array, height: int, width: int) -> Picture:
    """White noise of standard deviation 1, from anywhere in one pattern: new noise takes longer than all the rest."""
    with jax.ensure_compile_time_eval():
        pattern = jnp.asarray(np.random.default_rng(0).normal(size=(_GRAIN, _GRAIN)), jnp.float32)
    down, across = random.randint(key, (2,), 0, _GRAIN, jnp.int32)
    rows = pattern[(down + jnp.arange(height, dtype=jnp.int32)) % _GRAIN]
    return rows[:, (across + jnp.arange(width, dtype=jnp.int32)) % _GRAIN]


def _partly_hidden(key: Array, picture: Picture, share: float) -> Picture:
    height, width = picture.shape
    centre, sides, rest = (random.uniform(part, (2,), jnp.float32) for part in random.split(key, 3))
    low, high = _HIDDEN_SIDES
    half = (low + (high - low) * sides) / 2

    def within(size: int, centre: Scalar, half: Scalar) -> Array:
        return jnp.abs(jnp.arange(size, dtype=centre.dtype) / size - centre) < half

    inside = within(height, centre[1], half[1])[:, None] & within(width, centre[0], half[0])
    whether, grey = rest
    return jnp.where(inside & (whether < share), 255 * grey, picture)
