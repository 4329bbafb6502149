"""Orientation maps computed once for a face, from which any landmark's 4 × 4 × 8 histogram is 16 look-ups."""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jax import numpy as jnp
from jaxtyping import Array, Float, Int, UInt

from jaxfit.descriptors.normalise import NORMALISATIONS, require_choices
from jaxfit.errors import InputError
from jaxfit.image.frame import Frame
from jaxfit.image.sampling import split
from jaxfit.types import Crop, Features, Picture, Point, Scalar

CELLS = 4
BINS = 8
ORIENTATIONS = ("upright", "face")
# Crop pixels at each edge that smoothing and differences use up.
_MARGIN = 2
# Side of the squares of the fine map and of the coarse ones, in pixels of the picture that each is made of.
_FINE, _COARSE = 2, 4
# Side of a cell, in crop pixels, from which it is looked up in a coarse map.
_COARSE_CELL = 4.5
ZOOMS = (1, 2, 4, 8)
# Added to squared lengths, as the root has no derivative at flat places; pixels count in the thousands.
_TINY = 1e-6
_SECTOR = 2 * math.pi / BINS
_COS, _SIN = (f(np.arange(BINS) * _SECTOR).astype(np.float32) for f in (np.cos, np.sin))

Differences = Float[Array, "rows columns"]
Map = Float[Array, "down across 8"]
Histograms = Float[Array, "16 8"]


# Gradient magnitudes by orientation, summed over squares of 2 × 2 and of 4 × 4 pixels of the crop; and over those of
# 4 × 4 pixels of the crop shrunk to a half, to a quarter, and so on.
Maps = tuple[Float[Array, "_ _ 8"], ...]


class Places(NamedTuple):
    """Points of a map: the square whose centre is above and left of each, and how far towards the next ones it lies."""

    corner: UInt[Array, "points"]
    right_share: Float[Array, "points"]
    bottom_share: Float[Array, "points"]


@dataclass(frozen=True)
class Dense:
    """Histograms of gradient orientation like SIFT's, from maps that are shared by all windows.

    A map holds, for every 2 × 2 pixels of the crop, the gradient magnitudes by orientation; a second one does so for
    every 4 × 4 pixels. A cell of a window is a bilinear look-up at its centre in the map whose pixels suit its size.
    What differs from SIFT: cells grow with the window by these two sizes only, a gradient counts in the two
    orientations next to its own, and no weight falls towards the window's edge. (Sums of orientation maps are also what
    DAISY is made of; Tola, Lepetit and Fua, 2010.)

    With ``zoom``, crops show faces at so many times the resolution: steps in large windows look at the crop shrunk to
    the usual size, and later ones, whose windows are small, at more and more of its detail. The precision of fits then
    ends no longer at the pixels of a small face.

    Attributes:
        orientation: ``"upright"`` keeps the picture's axes; ``"face"`` turns the window with the face.
        normalisation: as `Sift` has it.
        zoom: how many times finer than usual crops are: 1, 2, 4 or 8.

    Raises:
        InputError: an unknown orientation or normalisation, or another zoom.
    """

    orientation: Literal["upright", "face"] = "upright"
    normalisation: Literal["cell", "root", "vector"] = "vector"
    zoom: int = 1

    def __post_init__(self) -> None:
        require_choices(self.orientation, ORIENTATIONS, self.normalisation)
        if self.zoom not in ZOOMS or type(self.zoom) is not int:
            raise InputError(f"expected a zoom of {', '.join(map(str, ZOOMS))}; got {self.zoom!r}")

    @property
    def frame(self) -> Frame:
        """The crops that suit it."""
        return Frame(crop=116 * self.zoom, face=64.0 * self.zoom)

    @property
    def size(self) -> int:
        """Length of one landmark's vector."""
        return CELLS * CELLS * BINS

    @property
    def turns(self) -> bool:
        """Whether the window turns with the face."""
        return self.orientation == "face"

    @property
    def levels(self) -> int:
        """One for each map."""
        return 1 + self._octaves

    @property
    def _octaves(self) -> int:
        """How many pictures there are to look at: the crop, its half, and so on."""
        return self.zoom.bit_length()

    def level(self, window: Scalar) -> Int[Array, ""]:
        """The map whose squares suit a window's cells."""
        finest = [_COARSE_CELL * 2**octave for octave in range(self._octaves)]
        return sum(((window / CELLS > cell).astype(jnp.int32) for cell in finest), start=jnp.zeros((), jnp.int32))

    def prepare(self, crop: Crop) -> Maps:
        """The fine and the coarse maps of a crop.

        Raises:
            InputError: the crop's side is not a multiple of 4, times the zoom.
        """
        if crop.shape[0] != crop.shape[1] or crop.shape[0] % (4 * self.zoom):
            raise InputError(
                f"expected square crops with a side that is a multiple of {4 * self.zoom} pixels; got {crop.shape}"
            )
        picture = crop.astype(jnp.float32)
        fine = pooled(*gradients(picture))
        maps = [fine, summed(fine)]
        for _ in range(1, self._octaves):
            picture = summed(picture[..., None])[..., 0] / 4
            maps.append(summed(pooled(*gradients(picture))))
        return tuple(maps)

    def aim(self, prepared: Maps, level: int, point: Point, side: Scalar, angle: Scalar) -> Places:
        """Where in the map the 4 × 4 cells (rows first) of the window of ``side`` pixels around ``point`` lie."""
        steps = (jnp.arange(CELLS, dtype=side.dtype) - (CELLS - 1) / 2) * (side / CELLS)
        x, y = jnp.meshgrid(steps, steps)
        if self.turns:
            cos, sin = jnp.cos(angle), jnp.sin(angle)
            x, y = x * cos - y * sin, x * sin + y * cos
        x, y = point[0] + x.reshape(-1), point[1] + y.reshape(-1)
        if level < 2:
            return places(x, y, len(prepared[level]), (_FINE, _COARSE)[level])
        shrunk = 2 ** (level - 1)
        x, y = ((each - (shrunk - 1) / 2) / shrunk for each in (x, y))
        return places(x, y, len(prepared[level]), _COARSE)

    def describe(self, prepared: Maps, level: int, aim: Places, angle: Scalar) -> Histograms:
        """The histograms of the 4 × 4 cells (rows first)."""
        found = look_up(prepared[level], aim)
        return jnp.matmul(found, turned_bins(angle)) if self.turns else found

    def normalise(self, histograms: Histograms) -> Features:
        """As one vector."""
        return NORMALISATIONS[self.normalisation](histograms)


def gradients(pixels: Picture) -> tuple[Differences, Differences]:
    """Differences dx, dy between neighbours in a picture smoothed by [1 2 1] in both directions, without its margin."""
    across = pixels[:, :-2] + 2 * pixels[:, 1:-1] + pixels[:, 2:]
    smoothed = across[:-2] + 2 * across[1:-1] + across[2:]
    return smoothed[1:-1, 2:] - smoothed[1:-1, :-2], smoothed[2:, 1:-1] - smoothed[:-2, 1:-1]


def orientations(dx: Float[Array, "*n"], dy: Float[Array, "*n"]) -> Float[Array, "*n 8"]:
    """Gradients by orientation: bin k answers to directions within 45° of k · 45°, most to its own."""
    dx, dy = dx[..., None], dy[..., None]
    length = jnp.sqrt(dx**2 + dy**2 + _TINY)
    return jnp.maximum(dx * _COS + dy * _SIN - math.cos(_SECTOR) * length, 0.0)


def pooled(dx: Differences, dy: Differences) -> Map:
    """Orientations of gradients, summed over squares of 2 × 2 pixels."""
    parts = [orientations(dx[i::2, j::2], dy[i::2, j::2]) for i in (0, 1) for j in (0, 1)]
    return sum(parts[1:], start=parts[0])


def summed(squares: Float[Array, "down across values"]) -> Float[Array, "half_down half_across values"]:
    """Sums over 2 × 2 squares."""
    quads = squares.reshape(len(squares) // 2, 2, len(squares) // 2, 2, -1)
    return quads[:, 0, :, 0] + quads[:, 0, :, 1] + quads[:, 1, :, 0] + quads[:, 1, :, 1]


def places(x: Float[Array, "points"], y: Float[Array, "points"], squares: int, stride: int) -> Places:
    """Where points of the crop lie in a map of ``squares`` squares a side, each of ``stride`` pixels; points beyond it
    are moved to its edge."""
    first = _MARGIN + (stride - 1) / 2  # where the first square has its centre
    left, right_share = split((x - first) / stride, squares)
    top, bottom_share = split((y - first) / stride, squares)
    # Unsigned: JAX would look for negative numbers, which count from the end.
    return Places((top * squares + left).astype(jnp.uint32), right_share, bottom_share)


def look_up(map_: Map, at: Places) -> Float[Array, "points 8"]:
    """A map at points, bilinearly."""
    squares = map_.reshape(-1, BINS)
    right_share, bottom_share = at.right_share[:, None], at.bottom_share[:, None]

    def line(start: UInt[Array, "points"]) -> Float[Array, "points 8"]:
        before = squares.at[start].get(mode="promise_in_bounds")
        after = squares.at[start + jnp.uint32(1)].get(mode="promise_in_bounds")
        return before + right_share * (after - before)

    upper, lower = line(at.corner), line(at.corner + jnp.uint32(len(map_)))
    return upper + bottom_share * (lower - upper)


def turned_bins(angle: Scalar) -> Float[Array, "8 8"]:
    """What turns histograms to a frame that is turned by ``angle``: each bin is shared between the two it falls on."""
    bins = jnp.arange(BINS, dtype=angle.dtype)
    away = (bins[:, None] - bins[None, :] - angle / _SECTOR) % BINS
    return jnp.maximum(0.0, 1.0 - jnp.minimum(away, BINS - away))
