"""Other pictures of the same face, to learn from: turned, scaled, sheared, blurred, noisy, or partly hidden."""

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

    Raises:
        InputError: a number is below 0, or a share above 1.
    """

    rotation: float = 0.15
    log_scale: float = 0.06
    shear: float = 0.05
    blur: float = 0.3
    noise: float = 2.0
    hidden: float = 0.2

    def __post_init__(self) -> None:
        values = vars(self).values()
        if not (all(map(math.isfinite, values)) and min(values) >= 0 and max(self.blur, self.hidden) <= 1):
            raise InputError(f"expected numbers of at least 0, and shares (blur, hidden) of at most 1; got {self}")


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


def disturbed(key: Array, crop: Crop, amounts: Disturbance) -> tuple[Crop, Warp]:
    """A crop (H, H) warped about its middle, and spoiled; and how it was warped."""
    of_warp, of_picture = random.split(key)
    warp = draw_warp(of_warp, amounts, jnp.full(2, (len(crop) - 1) / 2, jnp.float32))
    picture = spoiled(of_picture, warp.picture(crop.astype(jnp.float32)), amounts)
    return jnp.clip(jnp.round(picture), 0, 255).astype(jnp.uint8), warp


def spoiled(key: Array, picture: Picture, amounts: Disturbance) -> Picture:
    """A picture, in grey values, that is blurred, noisy or partly hidden, or not, as chance will have it."""
    of_blur, of_noise, of_hidden = random.split(key, 3)
    if amounts.blur:
        picture = _blurred(of_blur, picture, amounts.blur)
    if amounts.noise:
        strength, pattern = random.split(of_noise)
        deviation = amounts.noise * jnp.abs(random.normal(strength, (), jnp.float32))
        picture = picture + deviation * _grain(pattern, *picture.shape)
    return _partly_hidden(of_hidden, picture, amounts.hidden) if amounts.hidden else picture


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
