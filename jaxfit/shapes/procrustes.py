"""Aligning point sets by similarity transforms, in closed form."""

from jax import numpy as jnp

from jaxfit.shapes.space import Start
from jaxfit.types import Landmarks


def align_similarity(points: Landmarks, mean: Landmarks) -> Start:
    """The centre, scale and rotation that carry ``mean`` (centroid at the origin) onto ``points`` in least squares."""
    centre = points.mean(0)
    offset = points - centre
    # With points as complex numbers, the best similarity is one complex factor: scale · exp(i · rotation).
    power = jnp.sum(mean**2)
    real = jnp.sum(offset * mean) / power
    imaginary = jnp.sum(mean[:, 0] * offset[:, 1] - mean[:, 1] * offset[:, 0]) / power
    return Start(centre, jnp.hypot(real, imaginary), jnp.arctan2(imaginary, real))
