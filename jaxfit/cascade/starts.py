"""Where fits begin: how many starts a face has and how they are turned, and how starts are spread in training."""

from dataclasses import dataclass
from functools import cache

import jax
import numpy as np
from jax import numpy as jnp
from jax import vmap
from jaxtyping import Array, Float

from jaxfit.errors import InputError
from jaxfit.image.frame import Frame
from jaxfit.modes import own_modes
from jaxfit.shapes.space import ShapeSpace, Start, rotate
from jaxfit.types import Landmarks, Point, Scalar

# How far starts are turned in training, as a share of the range that they cover.
_REACH = 0.7


@jax.tree_util.register_static
@dataclass(frozen=True)
class Starts:
    """The initialisations of a fit: each face is fitted from several turned starts, and the fit nearest to all others
    is kept (thesis 3.2.3). A static pytree, so that it can be an argument of jitted functions.

    Attributes:
        count: how many starts a face has: one, or at least three. The time of a fit grows with it.
        low: lowest rotation of the starts, in degrees, clockwise as seen.
        high: highest rotation. The starts cover the range evenly; a single start lies in its middle. Faces upside down
            are left out by default, as in the thesis.

    Raises:
        InputError: no starts, or two, of which none is nearer to the others; or no range.
    """

    count: int = 1
    low: float = -90.0
    high: float = 90.0

    def __post_init__(self) -> None:
        if self.count < 1 or self.count == 2:
            raise InputError(
                f"expected one start or at least three (of two fits none is nearer to the others); got {self.count}"
            )
        if not -360 <= self.low <= self.high <= min(360, self.low + 360):
            raise InputError(
                "expected rotations of starts in degrees, the lowest first and at most a full circle apart, from -360 "
                f"to 360, such as -90 and 90; got {self.low:g} and {self.high:g}"
            )

    @property
    def rotations(self) -> Float[Array, "starts"]:
        """The rotations of the starts, in radians."""
        return _spread_evenly(self.count, float(self.low), float(self.high))

    @property
    def turn(self) -> float:
        """By how much starts are turned in training at most, in radians, so that fits from wrongly turned starts learn
        to come to the face; 0 for a single start.

        Most fits must come to the face wherever in the range it lies: otherwise their centroid lies elsewhere. Reaching
        over half the range would do if all fits from within reach succeeded.
        """
        return 0.0 if self.count == 1 else min(float(np.radians(_REACH * (self.high - self.low))), np.pi)


@cache  # computing them would take a tenth of the time of a single face
def _spread_evenly(count: int, low: float, high: float) -> Float[Array, "starts"]:
    """``count`` angles in radians, evenly over a range in degrees."""
    full_circle = high - low == 360  # both ends are the same
    several = np.linspace(low, high, count, endpoint=not full_circle)
    degrees = [(low + high) / 2] if count == 1 else several
    with own_modes(), jax.ensure_compile_time_eval():
        return jnp.asarray(np.radians(degrees), jnp.float32)


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the starts around the face box, measured on the training set.

    Attributes:
        shift: of the centre, in sides of the face box, for x and y.
        log_scale: of the logarithm of the scale.
        rotation: of the rotation, in radians.
    """

    shift: tuple[float, float]
    log_scale: float
    rotation: float

    @property
    def sigmas(self) -> Float[Array, "4"]:
        """All of them: of x, y, the logarithm of the scale, and the rotation."""
        return jnp.array([*self.shift, self.log_scale, self.rotation], jnp.float32)

    def scaled(self, factor: float) -> "Spread":
        """All of them times a factor."""
        across, down = self.shift
        return Spread((across * factor, down * factor), self.log_scale * factor, self.rotation * factor)


def starts_of(space: ShapeSpace, frame: Frame, rotations: Float[Array, "starts"]) -> Start:
    """Starts for one box, one for each rotation in radians: upright, in the middle of the crop at the canonical size.

    Turned, the mean face is moved and scaled to have the same bounding square as the upright one: around a turned face,
    which is wider or narrower, a box lies differently.
    """
    kind = rotations.dtype
    upright = Start(jnp.full(2, frame.middle, kind), jnp.ones((), kind), jnp.zeros((), kind))
    mean = space.landmarks(space.place(upright))

    def turned(rotation: Scalar) -> Start:
        middle, side = square_around(mean)
        there, larger = square_around(frame.middle + rotate(mean - frame.middle, rotation))
        scale = side / larger
        return Start(middle + scale * (frame.middle - there), scale, rotation)

    return vmap(turned)(rotations)


def square_around(points: Landmarks) -> tuple[Point, Scalar]:
    """Centre and side of the smallest square around points."""
    low, high = points.min(0), points.max(0)
    return (low + high) / 2, (high - low).max()
