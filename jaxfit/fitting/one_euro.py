"""The One-Euro filter: landmarks of a video that stand still when the face does and follow when it moves.

Casiez, Roussel and Vogel, *1€ Filter: A Simple Speed-based Low-pass Filter for Noisy Input in Interactive Systems*, CHI
2012. Speeds are measured in sizes of the face, so that neither the picture's resolution nor the distance matters.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxfit.errors import InputError


class Smoothed(NamedTuple):
    """What the filter knows of N points.

    Attributes:
        points: (N, D) smoothed.
        measured: (N, D) as they were measured.
        velocities: (N, D) smoothed, in sizes of the face a second; None before there was a second measurement.
        seconds: when that was.
    """

    points: np.ndarray
    measured: np.ndarray
    velocities: np.ndarray | None
    seconds: float


@dataclass(frozen=True)
class OneEuro:
    """How much to smooth: a low-pass filter of each point whose cutoff rises with the point's speed.

    At a constant speed v, points lag 1 / (2π (cutoff + gain v)) seconds behind.

    Attributes:
        cutoff: of points at rest, in hertz; less is smoother and slower.
        gain: of the cutoff with the speed, in hertz per size of the face a second; more follows faster.
        velocity_cutoff: of the speed, in hertz.

    Raises:
        InputError: a cutoff that is not positive, or a negative gain.
    """

    cutoff: float = 1.0
    gain: float = 20.0
    velocity_cutoff: float = 4.0

    def __post_init__(self) -> None:
        if not (0 < self.cutoff < math.inf and 0 < self.velocity_cutoff < math.inf and 0 <= self.gain < math.inf):
            raise InputError(f"expected positive cutoffs and a gain of 0 or more; got {self}")

    def start(self, points: np.ndarray, seconds: float) -> Smoothed:
        """The filter where nothing came before: points (N, D) as they are."""
        return Smoothed(points, points, None, seconds)

    def follow(self, before: Smoothed, points: np.ndarray, seconds: float, size: float) -> Smoothed:
        """The filter after the next measurement.

        Args:
            before: what it knew.
            points: (N, D) measured now.
            seconds: when; later than before.
            size: of the face, in the unit of the points.

        Raises:
            InputError: it is no later than before.
        """
        elapsed = seconds - before.seconds
        if not elapsed > 0:
            raise InputError(f"expected a time after {before.seconds} s; got {seconds} s")
        velocities = (points - before.measured) / (size * elapsed)
        if before.velocities is not None:
            velocities = before.velocities + _share(self.velocity_cutoff, elapsed) * (velocities - before.velocities)
        speeds = np.linalg.norm(velocities, axis=-1, keepdims=True)
        share = _share(self.cutoff + self.gain * speeds, elapsed)
        return Smoothed(before.points + share * (points - before.points), points, velocities, seconds)


def _share(cutoff: np.ndarray | float, elapsed: float) -> np.ndarray | float:
    """The weight of a measurement that comes some seconds after the last, for a cutoff in hertz."""
    turned = 2 * np.pi * cutoff * elapsed
    return turned / (turned + 1)
