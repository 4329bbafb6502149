"""A 3D shape model brought to 2D landmarks in a few Gauss-Newton steps, as many for every face: quick in batches.

One camera serves two views. A pinhole camera sees each point of a head at the point's own depth. The scaled
orthographic view of the thesis is that of a pinhole camera too, so far away that all points are as deep as the head's
origin.
"""

from typing import NamedTuple

from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfit.shapes.asm import ActiveShapeModel, Coefficients
from jaxfit.shapes.camera import align_shapes
from jaxfit.types import Landmarks, Landmarks3D, Rotation

_EXACT = lax.Precision.HIGHEST
STEPS = 3
# Standard deviation of landmarks' errors, a coordinate, and the distance from which a landmark counts less than half:
# shares of the mean head's radius.
NOISE = 0.03
CUT = 0.05
_POSE = 6  # three moves, three turns
_DAMPING = 1e-6  # of the mean of the normal equations' diagonal, for what the view does not show

Weights = Float[Array, "landmarks"]
Vector = Float[Array, "3"]


class HeadPose(NamedTuple):
    """Where a head is before a camera that sees points at depth 1 as far from its middle as they are from its axis.

    Attributes:
        rotation: (3, 3), from the head's axes to the camera's: x right, y down, z away from the viewer.
        translation: (3,) from the camera to the head's origin, in the model's unit.
        b: (M,) coefficients of the shape.
        ok: whether the landmarks determined it.
    """

    rotation: Rotation
    translation: Vector
    b: Coefficients
    ok: Bool[Array, ""]


def project(turned: Landmarks3D, translation: Vector, near: bool) -> Landmarks:
    """Where the camera sees points of a head that are turned as it is; ``near``: each at its own depth."""
    return (turned[:, :2] + translation[:2]) / _depths(turned, translation, near)


def pose_head(
    model: ActiveShapeModel,
    points: Landmarks,
    weights: Weights | None = None,
    *,
    near: bool = False,
    shape: Coefficients | None = None,
    noise: float = NOISE,
    cut: float = CUT,
    steps: int = STEPS,
) -> HeadPose:
    """The pose and the coefficients of a head that is seen at 2D landmarks.

    The first guess is the restricted camera that shows the mean head at the landmarks. The steps go to the most likely
    pose and coefficients together, if the landmarks err by ``noise`` and the coefficients by the model's deviations.
    Landmarks that lie far from where the head's are count less, the farther the less (Cauchy's weights): those of a jaw
    that is turned aside slide along its outline.

    Args:
        model: the 3D shape model, of L landmarks.
        points: (L, 2) landmarks as the camera of `HeadPose` sees them.
        weights: (L,) how much each landmark counts, 0 for those that are not known; None counts all alike.
        near: whether points are seen at their own depth, or all at that of the head's origin.
        shape: (M,) coefficients that are known; None finds them.
        noise: standard deviation of the landmarks' errors, as a share of the mean head's radius.
        cut: distance from which landmarks count less than half, likewise.
        steps: of Gauss and Newton.
    """
    weights = jnp.ones(len(points), points.dtype) if weights is None else weights
    known = jnp.where((weights > 0)[:, None], points, 0.0)
    radius = jnp.sqrt(jnp.mean(jnp.sum(model.mean**2, 1)))
    likely = model.modes * model.deviations[:, None, None]
    first = jnp.zeros_like(model.deviations) if shape is None else shape / model.deviations
    seen_first = model.mean + jnp.tensordot(first, likely, 1, precision=_EXACT)
    camera = align_shapes(seen_first, points, weights)
    distance = 1 / camera.scale
    free = likely if shape is None else likely[:0]
    prior = jnp.concatenate([jnp.zeros(_POSE, points.dtype), jnp.full(len(free), (noise * radius) ** 2, points.dtype)])

    def step(state: tuple[Rotation, Vector, Coefficients], _: None) -> tuple[tuple, None]:
        rotation, translation, b = state
        head = model.mean + jnp.tensordot(b, likely, 1, precision=_EXACT)
        turned = jnp.matmul(head, rotation.T, precision=_EXACT)
        # Lengths as they are at the depth of the head, in the model's unit.
        missing = translation[2] * (known - project(turned, translation, near))
        trusted = weights / (1 + jnp.sum(missing**2, 1) / (cut * radius) ** 2)
        moves = jnp.concatenate([_turns(turned), jnp.matmul(free, rotation.T, precision=_EXACT)])
        seen = jnp.concatenate([_moves(turned, translation, near), _seen(moves, turned, translation, near)])
        root = jnp.sqrt(trusted)[:, None]
        rows = (translation[2] * root * seen).reshape(len(seen), -1)
        normal = jnp.matmul(rows, rows.T, precision=_EXACT) + jnp.diag(prior)
        damping = _DAMPING * jnp.trace(normal) / len(normal) * jnp.eye(len(normal), dtype=normal.dtype)
        right = jnp.matmul(rows, (root * missing).reshape(-1), precision=_EXACT)
        at = jnp.concatenate([jnp.zeros(_POSE, b.dtype), b[: len(free)]])
        change = _solve(normal + damping, right - prior * at)
        rotation = jnp.matmul(_turn(change[3:_POSE]), rotation, precision=_EXACT)
        return (rotation, translation + change[:3], b.at[: len(free)].add(change[_POSE:])), None

    start = camera.rotation, jnp.append(camera.place * distance, distance), first
    (rotation, translation, b), _ = lax.scan(step, start, length=steps)
    ok = camera.ok & (translation[2] > 0) & jnp.isfinite(translation).all()
    return HeadPose(rotation, translation, b * model.deviations if shape is None else shape, ok)


def _depths(turned: Landmarks3D, translation: Vector, near: bool) -> Float[Array, "landmarks 1"]:
    return translation[2] + (turned[:, 2:] if near else jnp.zeros_like(turned[:, 2:]))


def _seen(moves: Float[Array, "moves landmarks 3"], turned: Landmarks3D, translation: Vector, near: bool) -> Array:
    """How points (moves, L, 2) move in the picture as they move before the camera."""
    ahead = moves[..., 2:] if near else jnp.zeros_like(moves[..., 2:])
    return (moves[..., :2] - project(turned, translation, near) * ahead) / _depths(turned, translation, near)


def _moves(turned: Landmarks3D, translation: Vector, near: bool) -> Float[Array, "3 landmarks 2"]:
    """How points move in the picture as the head moves right, down and away."""
    seen = project(turned, translation, near)
    none, one = jnp.zeros(len(seen), seen.dtype), jnp.ones(len(seen), seen.dtype)
    sideways = jnp.stack([jnp.stack([one, none], 1), jnp.stack([none, one], 1)])
    return jnp.concatenate([sideways, -seen[None]]) / _depths(turned, translation, near)


def _turns(turned: Landmarks3D) -> Float[Array, "3 landmarks 3"]:
    """How points move as they turn about the camera's three axes."""
    return jnp.cross(jnp.eye(3, dtype=turned.dtype)[:, None], turned)


def _turn(vector: Vector) -> Rotation:
    """The rotation about a vector, by its length in radians (Rodrigues)."""
    square = jnp.vdot(vector, vector)
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    about = jnp.cross(jnp.eye(3, dtype=vector.dtype), vector)
    first = jnp.where(small, 1.0, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5, (1 - jnp.cos(angle)) / angle**2)
    squared = jnp.matmul(about, about, precision=_EXACT)
    return jnp.eye(3, dtype=vector.dtype) + first * about + second * squared


def _solve(normal: Float[Array, "n n"], right: Float[Array, "n"]) -> Float[Array, "n"]:
    """A positive definite system, by Gauss and Jordan: of many small ones at once, quicker than one after the other."""

    def eliminated(row: Int[Array, ""], system: Array) -> Array:
        pivot = system[row] / system[row, row]
        rest = system - system[:, row, None] * pivot
        return rest.at[row].set(pivot)

    return lax.fori_loop(0, len(normal), eliminated, jnp.append(normal, right[:, None], 1))[:, -1]
