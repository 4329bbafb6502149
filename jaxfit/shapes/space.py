"""The seam for shape spaces: a coordinate system for faces."""

from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.head_pose import HeadPose
from jaxfit.types import Landmarks, Landmarks3D, Params, Point, Scalar


class Start(NamedTuple):
    """Where a face is first believed to be, in crop pixels.

    Attributes:
        centre: (2,) centre of the face.
        scale: size relative to the canonical face of the crop.
        rotation: radians, clockwise as seen.
    """

    centre: Point
    scale: Scalar
    rotation: Scalar

    def turned(self, pivot: Point, angle: Scalar) -> "Start":
        """The same start in a picture that is turned about ``pivot``, by ``angle`` radians clockwise as seen."""
        arm = self.centre - pivot
        # No angle, no change: not even by rounding.
        return Start(self.centre + (rotate(arm, angle) - arm), self.scale, self.rotation + angle)


@runtime_checkable
class ShapeSpace(Protocol):
    """Turns a parameter vector into landmarks and a step into new parameters; every array is one face, a pytree."""

    dimensions: ClassVar[int]  # of the points of its shape model: 2 or 3

    @property
    def size(self) -> int:
        """Number of parameters."""
        ...

    @property
    def closed_under_rotation(self) -> bool:
        """Whether :meth:`turned` is exact, every turned face being in the space, too."""
        ...

    def landmarks(self, params: Params) -> Landmarks:
        """Where to look, in crop pixels."""
        ...

    def scale(self, params: Params) -> Scalar:
        """Size of the face relative to the canonical face; descriptor windows grow with it."""
        ...

    def rotation(self, params: Params) -> Scalar:
        """In-plane rotation of the face, radians, clockwise as seen; descriptor windows may turn with it."""
        ...

    def turned(self, params: Params, angle: Scalar) -> Params:
        """The face turned about the crop's first pixel, by ``angle`` radians, clockwise as seen."""
        ...

    def encode(self, landmarks: Landmarks) -> Params:
        """The best parameters for known landmarks: training targets."""
        ...

    def place(self, start: Start) -> Params:
        """The mean face at a start."""
        ...

    def difference(self, target: Params, params: Params) -> Float[Array, "params"]:
        """The step that leads from ``params`` to ``target``, free of scale: what a regressor learns."""
        ...

    def advance(self, params: Params, step: Float[Array, "params"]) -> Params:
        """Apply a step."""
        ...


@runtime_checkable
class ShapeSpace3D(ShapeSpace, Protocol):
    """A shape space whose faces are three-dimensional: parameters say how the head is turned and how deep it is."""

    steady: ClassVar[bool]  # whether `encode` takes as long for every face, so that many are encoded side by side

    @property
    def model(self) -> ActiveShapeModel:
        """The 3D shape model, in pixels of the canonical face."""
        ...

    def landmarks_3d(self, params: Params) -> Landmarks3D:
        """The landmarks with their depths away from the viewer, in the same unit."""
        ...

    def pose(self, params: Params) -> Float[Array, "3"]:
        """Roll, pitch and yaw in degrees: clockwise as seen, looking up, nose to the image's left."""
        ...

    def b(self, params: Params) -> Float[Array, "modes"]:
        """The coefficients of the 3D shape model."""
        ...

    @property
    def modes(self) -> int:
        """Number of coefficients."""
        ...

    def before_camera(self, points: Landmarks, shape: Float[Array, "modes"] | None = None) -> HeadPose:
        """The head that a pinhole camera sees at points, at depth 1; ``shape``: its coefficients, if they are known."""
        ...

    def refined(self, landmarks: Landmarks) -> Params:
        """As :meth:`encode`, with coefficients and camera adjusted together afterwards; slow."""
        ...


def rotate(points: Float[Array, "*n 2"], angle: Scalar) -> Float[Array, "*n 2"]:
    """Points turned about the origin by ``angle`` radians, clockwise as seen, ``y`` being down."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = jnp.moveaxis(points, -1, 0)
    return jnp.stack([x * cos - y * sin, x * sin + y * cos], -1)


def wrapped(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The same angles, in radians, between -π and π."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))
