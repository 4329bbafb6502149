"""Models of 2D landmarks that find heads, too: a 3D head model aligned to the landmarks."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxfit.errors import InputError
from jaxfit.heads.model import DEFAULT_HEAD_MODEL, load_head_model
from jaxfit.models.model import Model
from jaxfit.modes import computing
from jaxfit.schemes.known import AFLW21, IBUG68
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.asm import likely_radius
from jaxfit.shapes.camera_asm import WeightedCameraASM

# Of the head's shape: more modes take longer, and say nothing of the pose.
_VARIANCE = 0.8
# Points of the face's outline, which slide along it as the head turns, while the head model's stay where they are.
_OUTLINES = {IBUG68.name: tuple(range(17)), AFLW21.name: (12, 16)}
_OUTLINE = 0.1  # how much they count


@computing
def with_heads(model: Model, head_model: str | Path = DEFAULT_HEAD_MODEL) -> Model:
    """A 2D model that also finds the head: landmarks in 3D, pose, scale and coefficients; its landmarks stay the same.

    The head model is aligned to the landmarks that the model finds, in a few steps
    (``jaxfit.shapes.head_pose.pose_head``).

    Args:
        model: of 2D landmarks.
        head_model: a bundled head model's name, or a file of one.

    Raises:
        InputError: the model is of a 3D method, or the head model lacks its landmarks.
        ModelError: no such head model.
    """
    if model.space_3d is not None:
        raise InputError("expected a model of 2D landmarks; this one finds heads by itself: leave out the head model")
    shape = load_head_model(head_model).in_pixels(model.scheme, _VARIANCE, model.cascade.frame.face)
    sigmas = jnp.float32(likely_radius(len(shape.deviations)))
    return replace(model, aligned=WeightedCameraASM(shape, sigmas, jnp.asarray(_weights(model.scheme))))


def ensure_heads(model: Model) -> Model:
    """The model itself if it finds heads, else as `with_heads` makes it.

    Raises:
        InputError: the head model of the package has no such landmarks.
    """
    return model if model.space_3d is not None else with_heads(model)


def _weights(scheme: Scheme) -> np.ndarray:
    """(L,) float32: how much each landmark says of the pose."""
    weights = np.ones(scheme.count, np.float32)
    weights[list(_OUTLINES.get(scheme.name, ()))] = _OUTLINE
    return weights
