"""Where heads are before a camera whose numbers are known: rotation, and position in millimetres."""

from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy
from jax import numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxfit.data.cameras import Camera
from jaxfit.errors import InputError
from jaxfit.fitting.batches import batches_of
from jaxfit.fitting.fits import Fits
from jaxfit.models.model import Model
from jaxfit.modes import computing
from jaxfit.shapes.head_pose import HeadPose
from jaxfit.shapes.space import ShapeSpace3D

PUPIL_DISTANCE = (
    63.0  # millimetres: the mean of adults (Dodgson, Variation and extrema of human interpupillary distance)
)


@dataclass(frozen=True)
class Placing:
    """How heads are placed before a camera.

    Attributes:
        camera: of all pictures.
        pupil_distance: of the people, in millimetres. A picture does not say how large a head is: positions are as
            exact as this distance. The default is right to within 6 % for two of three adults.

    Raises:
        InputError: the distance is not positive.
    """

    camera: Camera
    pupil_distance: float = PUPIL_DISTANCE

    def __post_init__(self) -> None:
        if not 0 < self.pupil_distance < np.inf:
            raise InputError(f"expected a distance of the pupils above 0 mm; got {self.pupil_distance:g}")

    def unit(self, model: Model) -> float:
        """The length in millimetres of a unit of a model's heads.

        Raises:
            InputError: the model finds no heads, or its landmarks have no pupils.
        """
        if model.space_3d is None or model.scheme.pupils is None:
            raise InputError(
                "expected a model that finds heads with eyes, such as jaxfit.with_heads makes, to place them before a "
                "camera; got another"
            )
        mean = np.asarray(model.space_3d.model.mean, np.float64)
        left, right = (mean[list(of_eye)].mean(0) for of_eye in model.scheme.pupils)
        return float(self.pupil_distance / np.linalg.norm(right - left))

    def settings(self) -> dict[str, Any]:
        """The settings as JSON values."""
        return {"camera": vars(self.camera), "pupil_distance": self.pupil_distance}


@computing
def place_heads(model: Model, fits: Fits, placing: Placing, shape: ArrayLike | None = None) -> Fits:
    """Find where heads are before a camera: the same fits with ``position`` and ``rotation_vector``.

    Each point of the 3D shape model is seen at its own depth, unlike in ``pose``; shape and place are adjusted together
    in a few Gauss-Newton steps.

    Args:
        model: whose fits; of 3D, such as ``jaxfit.with_heads`` makes.
        fits: N faces.
        placing: the camera, and how large heads are.
        shape: (M,) or (N, M) coefficients that are known, as in ``fits.b``; None finds each face's own.

    Raises:
        InputError: the model finds no heads, its landmarks have no pupils, or the fits are another model's.
    """
    unit = placing.unit(model)
    if fits.scheme.name != model.scheme.name or fits.b is None:
        raise InputError("place_heads: expected fits of the model, with heads; got another model's")
    placed = placed_heads(model, fits, placing.camera, shape)
    turns = np.full((len(fits), 3), np.nan)
    if placed.ok.any():
        turns[placed.ok] = scipy.spatial.transform.Rotation.from_matrix(placed.rotation[placed.ok]).as_rotvec()
    return replace(fits, position=unit * placed.translation, rotation_vector=turns)


class PlacedHeads(NamedTuple):
    """N heads before a camera, in the unit of the model; NaN where they are not ``ok``.

    Attributes:
        rotation: (N, 3, 3) float64.
        translation: (N, 3) float64.
        b: (N, M) float64, the coefficients of the shape.
        ok: (N,) bool, whether a face was fitted, and its landmarks say where the head is.
    """

    rotation: np.ndarray
    translation: np.ndarray
    b: np.ndarray
    ok: np.ndarray


@computing
def placed_heads(model: Model, fits: Fits, camera: Camera, shape: ArrayLike | None = None) -> PlacedHeads:
    """The heads of N fits before a camera; ``shape``, as in `place_heads`, are coefficients that are known."""
    assert model.space_3d is not None
    modes = model.space_3d.modes
    rows = np.flatnonzero(fits.fitted)  # pictures that could not be read have no size
    cameras = [camera.of_size(*size) for size in fits.sizes[fits.pictures[rows]].tolist()]
    numbers = np.array([[of.fx, of.fy, of.cx, of.cy] for of in cameras]).reshape(-1, 1, 4)
    points = (fits.landmarks[rows] - numbers[..., 2:]) / numbers[..., :2]
    known = None if shape is None else np.broadcast_to(np.asarray(shape, np.float32), (len(fits), modes))[rows]
    found = PlacedHeads(
        np.full((len(fits), 3, 3), np.nan),
        np.full((len(fits), 3), np.nan),
        np.full((len(fits), modes), np.nan),
        np.zeros(len(fits), bool),
    )
    for first, last in pairwise(accumulate(batches_of(len(rows)), initial=0)):
        of_batch = slice(first, last)
        batch = jnp.asarray(points[of_batch], jnp.float32)
        placed = _placed(model.space_3d, batch, None if known is None else jnp.asarray(known[of_batch]))
        ok = np.asarray(placed.ok)
        for whole, part in zip(found, placed, strict=True):
            whole[rows[of_batch][ok]] = np.asarray(part)[ok]
    return found


@jax.jit
def _placed(
    space: ShapeSpace3D,
    points: Float[Array, "faces landmarks 2"],
    shapes: Float[Array, "faces modes"] | None,
) -> HeadPose:
    return jax.vmap(space.before_camera, (0, None if shapes is None else 0))(points, shapes)
