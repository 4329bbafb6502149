"""The simplified SIFT of thesis 3.1: 32 × 32 samples, 4 × 4 cells, 8 orientations."""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfit.descriptors.normalise import NORMALISATIONS, require_choices
from jaxfit.image.frame import Frame
from jaxfit.image.sampling import Packed, bilinear, bilinear_grid, pack
from jaxfit.image.smoothing import smooth
from jaxfit.types import Crop, Features, Picture, Point, Scalar

SAMPLES = 32  # along a window's side, whatever its size in pixels
CELLS = 4
BINS = 8
ORIENTATION_BINS = 36
ORIENTATIONS = ("upright", "face", "principal")
_WEIGHT_SIGMA = SAMPLES / 2
_OFFSETS = np.arange(SAMPLES) - (SAMPLES - 1) / 2
_FRAMED = np.arange(-1, SAMPLES + 1) - (SAMPLES - 1) / 2  # one sample more on each side, for central differences
_WEIGHTS = np.exp(-(_OFFSETS[:, None] ** 2 + _OFFSETS[None, :] ** 2) / (2 * _WEIGHT_SIGMA**2)).astype(np.float32)

Samples = Float[Array, "32 32"]
Window = Float[Array, "34 34"]


class Prepared(NamedTuple):
    """A smoothed crop, ready for upright windows, and packed for turned ones, if there are any."""

    smoothed: Picture
    packed: Packed | None


class Aim(NamedTuple):
    """A window in the crop."""

    point: Point
    side: Scalar


@dataclass(frozen=True)
class Sift:
    """Simplified SIFT; the defaults are what the cascade uses best, not what the thesis prints.

    Attributes:
        orientation: ``"upright"`` keeps the picture's axes (the original SDM); ``"face"`` turns the window with the
            face, by the rotation of its current state; ``"principal"`` turns it by the landmark's principal gradient
            orientation (thesis 3.1), which turns with the face, too.
        normalisation: ``"cell"`` makes each cell's histogram sum to 1 (thesis 3.1); ``"vector"`` gives the whole
            vector Euclidean length 1 (Lowe); ``"root"`` takes roots of the bins' shares (RootSIFT).
    """

    orientation: Literal["upright", "face", "principal"] = "upright"
    normalisation: Literal["cell", "root", "vector"] = "vector"

    def __post_init__(self) -> None:
        require_choices(self.orientation, ORIENTATIONS, self.normalisation)

    @property
    def frame(self) -> Frame:
        """The crops that suit it."""
        return Frame()

    @property
    def size(self) -> int:
        """Length of one landmark's vector."""
        return CELLS * CELLS * BINS

    @property
    def turns(self) -> bool:
        """Whether the window turns with the face."""
        return self.orientation != "upright"

    @property
    def levels(self) -> int:
        """One: samples are spread over the window."""
        return 1

    def level(self, window: Scalar) -> Int[Array, ""]:
        """The only one."""
        return jnp.zeros((), jnp.int32)

    def prepare(self, crop: Crop) -> Prepared:
        """The crop, smoothed by σ = 1.6 pixels."""
        smoothed = smooth(crop.astype(jnp.float32))
        return Prepared(smoothed, pack(smoothed) if self.turns else None)

    def aim(self, prepared: Prepared, level: int, point: Point, side: Scalar, angle: Scalar) -> Aim:
        """The middle and the side of the window."""
        return Aim(point, side)

    def describe(self, prepared: Prepared, level: int, aim: Aim, angle: Scalar) -> Float[Array, "16 8"]:
        """The histograms in a window: 4 × 4 cells (rows first) × 8 bins.

        The 32 × 32 samples are spread over the window whatever its size, and differences are taken between
        neighbouring samples: a picture twice as large, in a window twice as large, has the same descriptor.
        """
        point, spacing = aim.point, aim.side / SAMPLES
        if self.turns and prepared.packed is not None:
            turn = self.window_angle(prepared, point, aim.side, angle)
            window = rotated_window(prepared.packed, point, spacing, turn)
        else:
            window = upright_window(prepared.smoothed, point, spacing)
        return cell_histograms(window)

    def normalise(self, histograms: Float[Array, "16 8"]) -> Features:
        """As one vector of length 128; what is empty stays zero."""
        return NORMALISATIONS[self.normalisation](histograms)

    def window_angle(self, prepared: Prepared, point: Point, side: Scalar, angle: Scalar) -> Scalar:
        """How far the window of ``describe`` is turned, in radians, clockwise as seen."""
        if self.orientation == "principal":
            return principal_orientation(upright_window(prepared.smoothed, point, side / SAMPLES))
        return angle if self.turns else jnp.zeros((), jnp.float32)


def upright_window(picture: Picture, point: Point, spacing: Scalar) -> Window:
    """The picture at 32 × 32 samples around ``point``, and one more on each side, ``spacing`` pixels apart."""
    offsets = jnp.asarray(_FRAMED, jnp.float32) * spacing
    return bilinear_grid(picture, point[0] + offsets, point[1] + offsets)


def rotated_window(packed: Packed, point: Point, spacing: Scalar, angle: Scalar) -> Window:
    """The same along axes rotated by ``angle`` radians (Eq. 5).

    Positive angles turn the x axis towards the y axis, which is clockwise as seen, ``y`` being down.
    """
    offsets = jnp.asarray(_FRAMED, jnp.float32) * spacing
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x = point[0] + offsets[None, :] * cos - offsets[:, None] * sin
    y = point[1] + offsets[None, :] * sin + offsets[:, None] * cos
    return bilinear(packed, x, y)


@jax.custom_jvp
def _kept(window: Window) -> Window:
    """The same window.

    A look-up of all lines in their order changes nothing, but XLA keeps what is looked up in memory. It would otherwise
    sample the picture again for each bin of the histograms, which takes three times as long.
    """
    return window.at[jnp.arange(SAMPLES + 2)].get(mode="promise_in_bounds")


@_kept.defjvp
def _kept_change(primals: tuple[Window], tangents: tuple[Window]) -> tuple[Window, Window]:
    return _kept(*primals), tangents[0]


def gradients(window: Window) -> tuple[Samples, Samples]:
    """Differences dx, dy between each sample's neighbours along the window's axes (Eq. 3, 4)."""
    window = _kept(window)
    dx = window[1:-1, 2:] - window[1:-1, :-2]
    dy = window[2:, 1:-1] - window[:-2, 1:-1]
    return dx, dy


def magnitude(dx: Float[Array, "*n"], dy: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Gradient magnitudes (Eq. 4); the derivative is zero, not NaN, where the picture is flat."""
    squared = dx**2 + dy**2
    flat = squared == 0
    return jnp.where(flat, 0.0, jnp.sqrt(jnp.where(flat, 1.0, squared)))


def octant(dx: Float[Array, "*n"], dy: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """Bin 0..7 of the gradients' orientations (Eq. 3), bin k covering [k, k + 1) · 45°, without slow arctangents."""
    upper = (dy > 0) | ((dy == 0) & (dx >= 0))
    x, y = jnp.where(upper, dx, -dx), jnp.where(upper, dy, -dy)
    within_half = sum(beyond.astype(jnp.int32) for beyond in (y >= x, x <= 0, y <= -x))
    return jnp.where(upper, 0, 4) + jnp.where((x == 0) & (y == 0), 0, within_half)


def principal_orientation(window: Window) -> Scalar:
    """Centre, in radians, of the fullest of 36 bins of gradient orientation, magnitudes weighted by a Gaussian."""
    dx, dy = gradients(window)
    turns = (jnp.arctan2(dy, dx) / (2 * math.pi)) % 1.0
    bins = jnp.minimum((turns * ORIENTATION_BINS).astype(jnp.int32), ORIENTATION_BINS - 1)
    histogram = jnp.zeros(ORIENTATION_BINS, window.dtype).at[bins].add(magnitude(dx, dy) * _WEIGHTS)
    # The fullest bin is a choice: it passes no gradient, and arctan2 has none at flat places.
    return lax.stop_gradient((jnp.argmax(histogram).astype(window.dtype) + 0.5) * (2 * math.pi / ORIENTATION_BINS))


def cell_histograms(window: Window) -> Float[Array, "16 8"]:
    """Histograms of gradient orientation of the 4 × 4 cells, magnitudes weighted by a Gaussian of σ = 16 samples."""
    dx, dy = gradients(window)
    return _sums_of_cells(magnitude(dx, dy) * _WEIGHTS, octant(dx, dy))


@jax.custom_jvp
def _sums_of_cells(weighted: Samples, bins: Int[Array, "32 32"]) -> Float[Array, "16 8"]:
    """The samples of each cell and bin, added up."""
    side = SAMPLES // CELLS
    weighted, bins = weighted.reshape(CELLS, side, SAMPLES), bins.reshape(CELLS, side, SAMPLES)

    each = jnp.arange(BINS, dtype=jnp.int32)[:, None, None]
    # Added line by line: on CPU this is ten times faster than XLA's reductions and scatters.
    lines = [jnp.where(bins[:, i] == each, weighted[:, i], 0.0) for i in range(side)]
    cells = sum(lines[1:], start=lines[0]).reshape(BINS, CELLS, CELLS, side).sum(3)
    return jnp.moveaxis(cells, 0, 2).reshape(CELLS * CELLS, BINS)


@_sums_of_cells.defjvp
def _change_of_sums(
    primals: tuple[Samples, Int[Array, "32 32"]], tangents: tuple[Samples, Any]
) -> tuple[Float[Array, "16 8"], Float[Array, "16 8"]]:
    """Written so that its transpose, which gradients take, is a look-up in the 8 bins, and not a sum of lines."""
    _, bins = primals
    change = jnp.where(bins[..., None] == jnp.arange(BINS, dtype=jnp.int32), tangents[0][..., None], 0.0)
    side = SAMPLES // CELLS
    return _sums_of_cells(*primals), change.reshape(CELLS, side, CELLS, side, BINS).sum((1, 3)).reshape(-1, BINS)
