"""The 3D methods' shape space: a 3D Active Shape Model seen by the restricted camera (thesis 3.3, 3.4)."""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.shapes.alignment import Alignment, align_head, refine_head
from jaxfit.shapes.asm import ActiveShapeModel, Coefficients
from jaxfit.shapes.camera import (
    Camera,
    align_shapes,
    in_plane,
    pose_degrees,
    rotation_angles,
    rotation_matrix,
    show,
    turn_in_plane,
)
from jaxfit.shapes.head_pose import HeadPose, pose_head
from jaxfit.shapes.space import Start, rotate, wrapped
from jaxfit.types import Landmarks, Landmarks3D, Params, Point, Scalar

_NEAR_STEPS = 6  # perspective is farther from the first guess
_POSE = 6  # s, d_x, d_y, θ, γ, η
_EXACT = lax.Precision.HIGHEST


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CameraASM:
    """p = ⟨b, s, d_x, d_y, θ, γ, η⟩ (Eq. 14): coefficients, scale, place in crop pixels, roll, pitch, yaw in radians.

    Attributes:
        model: the 3D Active Shape Model, in pixels of the canonical face.
        sigmas: radius, in standard deviations, of the ellipsoid that b is kept in; the thesis's is 3.
    """

    model: ActiveShapeModel
    sigmas: Scalar

    dimensions: ClassVar[int] = 3
    steady: ClassVar[bool] = False

    @property
    def size(self) -> int:
        """Number of parameters, m + 6."""
        return self.modes + _POSE

    @property
    def modes(self) -> int:
        """Number of coefficients, m."""
        return len(self.model.deviations)

    @property
    def closed_under_rotation(self) -> bool:
        """The camera turns all heads alike."""
        return True

    def landmarks(self, params: Params) -> Landmarks:
        """L₂D = P · s · R_η · R_γ · R_θ · L₃D' + T (Eq. 15)."""
        return self.landmarks_3d(params)[:, :2]

    def landmarks_3d(self, params: Params) -> Landmarks3D:
        """The landmarks with their depths, in the same unit; 0 is the depth of the mean face's centroid."""
        return show(self.model.reconstruct(params[:-_POSE]), _camera(params))

    def pose(self, params: Params) -> Float[Array, "3"]:
        """Roll, pitch and yaw in degrees, as they are reported: clockwise, looking up, nose to the image's left."""
        return pose_degrees(*params[-3:])

    def b(self, params: Params) -> Coefficients:
        """The coefficients."""
        return params[:-_POSE]

    def scale(self, params: Params) -> Scalar:
        """s."""
        return params[-_POSE]

    def rotation(self, params: Params) -> Scalar:
        """How far the head is turned in the picture; of an upright head of any pitch and yaw, 0."""
        return in_plane(rotation_matrix(*params[-3:]))

    def turned(self, params: Params, angle: Scalar) -> Params:
        """The head and its place turned; all angles change, b and s stay."""
        camera = _camera(params)
        rotation = jnp.matmul(turn_in_plane(angle), camera.rotation, precision=_EXACT)
        # No angle, no change: not even by rounding.
        angles = jnp.where(angle == 0, params[-3:], rotation_angles(rotation))
        return _joined(params[:-_POSE], camera.scale, rotate(camera.place, angle), angles)

    def encode(self, landmarks: Landmarks) -> Params:
        """The parameters of known landmarks, by :func:`align_head`.

        Where b leaves the ellipsoid it is pulled back, and the camera is then the best one for it. The angles are NaN
        where the landmarks, such as points on a line, do not determine them.
        """
        return self._restricted(landmarks, align_head(self.model, landmarks))

    def refined(self, landmarks: Landmarks) -> Params:
        """As :meth:`encode`, with b and the camera adjusted together afterwards (:func:`refine_head`)."""
        return self._restricted(landmarks, refine_head(self.model, landmarks, align_head(self.model, landmarks)))

    def before_camera(self, points: Landmarks, shape: Coefficients | None = None) -> HeadPose:
        """The head that a pinhole camera sees at points, at depth 1; ``shape``: its coefficients, if they are known."""
        return pose_head(self.model, points, near=True, shape=shape, steps=_NEAR_STEPS)

    def _restricted(self, landmarks: Landmarks, found: Alignment) -> Params:
        b, camera, _, _ = found
        inside = self.model.restrict(b, self.sigmas)
        again = align_shapes(self.model.reconstruct(inside), landmarks, jnp.ones(len(landmarks), landmarks.dtype))
        scale, rotation, place, ok = jax.tree.map(partial(jnp.where, (inside == b).all()), camera, again)
        return _joined(inside, scale, place, jnp.where(ok, rotation_angles(rotation), jnp.nan))

    def place(self, start: Start) -> Params:
        """The mean face, b = 0, from the front, at a start."""
        straight = jnp.zeros_like(start.rotation)
        angles = jnp.stack([wrapped(-start.rotation), straight, straight])
        return _joined(jnp.zeros_like(self.model.deviations), start.scale, start.centre, angles)

    def difference(self, target: Params, params: Params) -> Float[Array, "params"]:
        """b and the angles by difference, these the shorter way round; the place in units of s; s by log ratio.

        The thesis regresses plain differences. Free of scale, one regressor serves faces of all sizes (3.2.2).
        """
        apart = target - params
        return _joined(
            apart[:-_POSE],
            jnp.log(self.scale(target) / self.scale(params)),
            apart[-5:-3] / self.scale(params),
            wrapped(apart[-3:]),
        )

    def advance(self, params: Params, step: Float[Array, "params"]) -> Params:
        """Apply a step, and pull b back into the ellipsoid."""
        scale = self.scale(params)
        return _joined(
            self.model.restrict(params[:-_POSE] + step[:-_POSE], self.sigmas),
            scale * jnp.exp(step[-_POSE]),
            params[-5:-3] + scale * step[-5:-3],
            wrapped(params[-3:] + step[-3:]),
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WeightedCameraASM(CameraASM):
    """The same space, of landmarks that count differently: brought to them in a few steps (:func:`pose_head`), which is
    much quicker than the alternation.

    Attributes:
        weights: (L,) how much each landmark counts.
    """

    weights: Float[Array, "landmarks"]

    steady: ClassVar[bool] = True

    def encode(self, landmarks: Landmarks) -> Params:
        """The parameters of known landmarks, by :func:`pose_head`; b is pulled back where it leaves the ellipsoid.

        The angles are NaN where the landmarks do not determine them.
        """
        rotation, translation, b, ok = pose_head(self.model, landmarks, self.weights)
        scale = 1 / jnp.where(ok, translation[2], 1.0)
        angles = jnp.where(ok, rotation_angles(rotation), jnp.nan)
        return _joined(self.model.restrict(b, self.sigmas), scale, scale * translation[:2], angles)

    def before_camera(self, points: Landmarks, shape: Coefficients | None = None) -> HeadPose:
        """As that of `CameraASM`, of landmarks that count differently."""
        return pose_head(self.model, points, self.weights, near=True, shape=shape, steps=_NEAR_STEPS)


def _camera(params: Params) -> Camera:
    return Camera(params[-_POSE], rotation_matrix(*params[-3:]), params[-5:-3], jnp.array(True))


def _joined(b: Coefficients, scale: Scalar, place: Point, angles: Float[Array, "3"]) -> Params:
    return jnp.concatenate([b, scale[None], place, angles])
