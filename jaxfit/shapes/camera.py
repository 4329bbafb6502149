"""The restricted camera (thesis 3.3, 3.4): a scaled orthographic view of a head, its rotation (Eq. 15), and its pose.

3D points are ``x`` right, ``y`` down and ``z`` away from the viewer, a right-handed frame; all in one unit.
"""

from typing import Literal, NamedTuple

from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfit.types import Landmarks, Landmarks3D, Point, Rotation, Scalar

_EXACT = lax.Precision.HIGHEST
_FEWEST = 4  # points that determine a camera, not all in a plane
# Shares of the largest extent below which points count as flat, and rows of a camera as parallel.
_FLAT = 1e-3

ANGLES = ("roll", "pitch", "yaw")  # the columns of poses

# The order in which the three rotations of a pose are applied to the upright head: the first is Eq. 15's.
PoseOrder = Literal["roll-pitch-yaw", "roll-yaw-pitch"]
DEFAULT_ORDER: PoseOrder = "roll-pitch-yaw"  # Eq. 15's, which all poses of jaxfit are in


class Camera(NamedTuple):
    """How a head is seen: points x of the head lie at ``scale · rotation · x`` and ``place``, their depth dropped.

    Attributes:
        scale: s, pixels per unit of the head.
        rotation: (3, 3) R', from the head's axes to the picture's.
        place: (2,) d, pixels.
        ok: whether the points determined it; else it shows the head upright, from the front.
    """

    scale: Scalar
    rotation: Rotation
    place: Point
    ok: Bool[Array, ""]


def rotation_matrix(theta: Scalar, gamma: Scalar, eta: Scalar) -> Rotation:
    """R' = R_η · R_γ · R_θ of Eq. 15, with its third row; radians, θ counter-clockwise (see `pose_degrees`)."""
    c_t, s_t, c_g, s_g, c_e, s_e = (f(angle) for angle in (theta, gamma, eta) for f in (jnp.cos, jnp.sin))
    return jnp.array(
        [
            [c_e * c_t + s_e * s_g * s_t, c_e * s_t - s_e * s_g * c_t, s_e * c_g],
            [-c_g * s_t, c_g * c_t, s_g],
            [-s_e * c_t + c_e * s_g * s_t, -s_e * s_t - c_e * s_g * c_t, c_e * c_g],
        ]
    )


def rotation_angles(rotation: Rotation) -> Float[Array, "3"]:
    """θ, γ, η of a rotation (Eq. 15), in radians: θ and η in (-π, π], γ between -π/2 and π/2.

    Where γ is ±π/2, roll and yaw turn about the same axis, and θ is taken as 0.
    """
    ahead = _length(rotation[::2, 2])
    gamma = jnp.arctan2(rotation[1, 2], ahead)
    straight_up = ahead < 1e-6
    eta_there = (-rotation[2, 0], rotation[0, 0])
    eta = jnp.arctan2(
        jnp.where(straight_up, eta_there[0], rotation[0, 2]), jnp.where(straight_up, eta_there[1], rotation[2, 2])
    )
    theta = jnp.arctan2(jnp.where(straight_up, 0.0, -rotation[1, 0]), jnp.where(straight_up, 1.0, rotation[1, 1]))
    return jnp.stack([theta, gamma, eta])


def pose_degrees(theta: Scalar, gamma: Scalar, eta: Scalar) -> Float[Array, "3"]:
    """Roll, pitch and yaw as they are reported, in degrees: clockwise as seen, looking up, nose to the image's left.

    Eq. 15's θ turns counter-clockwise where ``y`` is down.
    """
    return jnp.rad2deg(jnp.stack([-theta, gamma, eta]))


def pose_rotation(pose: Float[Array, "3"]) -> Rotation:
    """The rotation of a pose as :func:`pose_degrees` reports it."""
    roll, pitch, yaw = jnp.deg2rad(pose)
    return rotation_matrix(-roll, pitch, yaw)


def in_plane(rotation: Rotation) -> Scalar:
    """How far a head is turned in the picture, in radians, clockwise as seen: its rotation's twist about ``z``.

    What is left of the rotation without it turns about an axis in the picture. Defined for every head but those seen
    from behind, unlike the direction of the line through the eyes, which profiles lack.
    """
    sin, cos = rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1]
    return jnp.arctan2(*_away_from_zero(sin, cos))


def turn_in_plane(angle: Scalar) -> Rotation:
    """The rotation by ``angle`` radians, clockwise as seen, about ``z``."""
    return rotation_matrix(-angle, jnp.zeros_like(angle), jnp.zeros_like(angle))


def rq(matrix: Float[Array, "3 3"]) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
    """The RQ decomposition U · V of a regular matrix: U upper triangular with a positive diagonal, V orthogonal.

    The positive diagonal takes the place of the thesis's matrix W of signs.
    """
    rows: list[Array] = []
    for row in matrix[::-1]:
        for known in rows:
            row = row - jnp.vdot(row, known, precision=_EXACT) * known
        rows.append(row / _length(row))
    orthogonal = jnp.stack(rows[::-1])
    return jnp.triu(jnp.matmul(matrix, orthogonal.T, precision=_EXACT)), orthogonal


def align_shapes(head: Landmarks3D, points: Landmarks, weights: Float[Array, "landmarks"]) -> Camera:
    """The restricted camera that shows a rigid head at 2D points: ``AlignShapes`` of thesis 3.3.

    Least squares for a general 2 × 3 camera, its cross product as the third row, RQ, and the mean of the two scales.

    Args:
        head: (L, 3), in any unit.
        points: (L, 2), in pixels; may be anything where the weight is 0.
        weights: (L,) how much each point counts, 0 for those that are not known.

    Returns:
        The camera; not ``ok`` with fewer than four points, or where they lie in a plane of the head, on a line of the
        picture, or in one point.
    """
    known = weights > 0
    labelled = jnp.where(known[:, None], points, 0.0)
    share = weights / jnp.maximum(weights.sum(), 1e-12)
    middle_3d, middle_2d = (jnp.matmul(share, of, precision=_EXACT) for of in (head, labelled))
    solid, flat = head - middle_3d, jnp.where(known[:, None], labelled - middle_2d, 0.0)
    # Without units: a flat shape is then known whatever its size.
    size_3d = jnp.sqrt(jnp.maximum(jnp.sum(share[:, None] * solid**2), 1e-12))
    size_2d = jnp.sqrt(jnp.maximum(jnp.sum(share[:, None] * flat**2), 1e-12))
    solid, flat = solid / size_3d, flat / size_2d
    scatter = jnp.einsum("l,li,lj->ij", share, solid, solid, precision=_EXACT)
    mixed = jnp.einsum("l,li,lj->ij", share, flat, solid, precision=_EXACT)
    # The inverse of a 3 × 3 matrix by its cross products: a general solver takes seconds to compile.
    adjugate = jnp.cross(jnp.roll(scatter, -1, 0), jnp.roll(scatter, -2, 0)).T
    volume = jnp.vdot(scatter[0], adjugate[:, 0], precision=_EXACT)
    deep = volume > _FLAT**2 * jnp.trace(scatter) ** 3 / 27
    first, second = jnp.matmul(mixed, adjugate, precision=_EXACT) / jnp.where(deep, volume, 1.0)
    third = jnp.cross(first, second)
    spread = jnp.vdot(third, third) > _FLAT**2 * jnp.maximum(jnp.vdot(first, first), jnp.vdot(second, second)) ** 2
    ok = deep & spread & (known.sum() >= _FEWEST) & (size_2d > 1e-5) & jnp.isfinite(size_2d + size_3d)
    scales, rotation = rq(jnp.where(ok, jnp.stack([first, second, third]), jnp.eye(3, dtype=first.dtype)))
    scale = (scales[0, 0] + scales[1, 1]) / 2 * jnp.where(jnp.isfinite(size_2d), size_2d, 1.0) / size_3d
    place = middle_2d - scale * jnp.matmul(rotation, middle_3d, precision=_EXACT)[:2]
    return Camera(scale, rotation, jnp.where(jnp.isfinite(place), place, 0.0), ok)


def show(head: Landmarks3D, camera: Camera) -> Landmarks3D:
    """A head's points as the camera sees them: x and y in pixels of the picture, and their depth in the same unit."""
    turned = camera.scale * jnp.matmul(head, camera.rotation.T, precision=_EXACT)
    return turned.at[:, :2].add(camera.place)


def _away_from_zero(sin: Scalar, cos: Scalar) -> tuple[Scalar, Scalar]:
    """The same, but (0, 1) for (0, 0), where an angle has no derivative."""
    nowhere = (sin == 0) & (cos == 0)
    return jnp.where(nowhere, 0.0, sin), jnp.where(nowhere, 1.0, cos)


def _length(vector: Float[Array, "n"]) -> Scalar:
    return jnp.sqrt(jnp.maximum(jnp.vdot(vector, vector, precision=_EXACT), 1e-24))
