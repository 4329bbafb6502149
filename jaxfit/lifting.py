"""Labels of one landmark scheme, some of them missing, as complete labels of another: through a 3D head model.

Visible points of a turned face give its camera and shape, and with them the points that are hidden or not labelled.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfit.data.records import FaceRecord
from jaxfit.evaluation.pose import in_order
from jaxfit.models.heads import HeadModel
from jaxfit.shapes.alignment import Weights, align_head
from jaxfit.shapes.asm import ActiveShapeModel, likely_radius
from jaxfit.shapes.camera import pose_degrees, rotation_angles, show
from jaxfit.shapes.schemes import Scheme
from jaxfit.types import Landmarks

# Fewer points leave too much open.
_FEWEST = 8
# Mean distance of the known points from where the head model puts them, in sides of the face, beyond which they are
# no face's.
_WORST = 0.05
# Cosine of the angle to the viewer, beyond which a face would be seen from behind; profiles are there or thereabouts.
_BEHIND = -0.3
# Degrees between the pose that the points give and the labelled one, beyond which one of them is wrong.
_DISAGREE = 20.0
_VARIANCE = 0.99


@dataclass(frozen=True)
class Lifted:
    """Faces with labels of another scheme.

    Attributes:
        faces: the faces, all landmarks of the target scheme present, in the order of the given ones; ``visible`` is
            unknown and all True. ``pose`` is that of the 3D alignment.
        problems: how many were left out and why, a sentence each.
    """

    faces: tuple[FaceRecord, ...]
    problems: tuple[str, ...]


def lift_labels(
    faces: Sequence[FaceRecord], source: Scheme, target: Scheme, head: HeadModel, least_yaw: float = 0.0
) -> Lifted:
    """Labels of ``target`` for faces labelled with (some of) ``source``.

    Left out are faces with fewer than eight labelled points, those that the head model does not explain, and those
    whose labelled pose differs by more than 20 degrees, in pitch or yaw, from the one that the points give.

    Args:
        faces: labelled faces.
        source: what their landmarks mean.
        target: what the new ones shall mean.
        head: has the points of both.
        least_yaw: leave faces out, too, that are turned by fewer degrees to either side.

    Raises:
        InputError: the head model lacks one of the schemes.
    """
    given, wanted = head.indices(source), head.indices(target)
    model = head.of_points([*given, *wanted], _VARIANCE)
    known = np.array([face.present for face in faces]).reshape(-1, source.count)
    labels = np.array([face.landmarks for face in faces]).reshape(-1, source.count, 2)
    labels = np.where(known[..., None], labels, 0.0)
    # float32 would lose sub-pixels in the corner of a large picture.
    share = known / np.maximum(known.sum(-1, keepdims=True), 1)
    middles = np.einsum("nl,nld->nd", share, labels)
    points = np.pad(labels - middles[:, None], ((0, 0), (0, target.count), (0, 0)))
    weights = np.pad(known, ((0, 0), (0, target.count)))
    shown, poses, ok, likely = jax.tree.map(np.asarray, _align(model, *map(jnp.float32, (points, weights))))
    enough = ok & (known.sum(1) >= _FEWEST)
    comparable = in_order(poses, [face.pose_order for face in faces])
    agree = np.array([_agree(face, pose) for face, pose in zip(faces, comparable, strict=True)], bool)
    turned = np.abs(poses[:, 2]) >= least_yaw
    problems, kept = [], np.ones(len(faces), bool)
    for good, why in (
        (enough, f"fewer than {_FEWEST} labelled points, or all on a line"),
        (likely, "their points are not where those of a face can be"),
        (agree, f"their points tell a pose more than {_DISAGREE:.0f} degrees from the labelled one"),
        (turned, f"turned by less than {least_yaw:g} degrees"),
    ):
        if dropped := int((kept & ~good).sum()):
            problems.append(f"{dropped} of {len(faces)} faces left out: {why}")
        kept &= good
    present = np.ones(target.count, bool)
    lifted = [
        replace(
            faces[n],
            landmarks=shown[n, source.count :].astype(np.float64) + middles[n],
            present=present,
            visible=present.copy(),
            pose=poses[n].astype(np.float64),
            pose_order="roll-pitch-yaw",
        )
        for n in map(int, np.flatnonzero(kept))
    ]
    return Lifted(tuple(lifted), tuple(problems))


def _agree(face: FaceRecord, pose: np.ndarray) -> bool:
    """Whether the labelled pitch and yaw, if known, are near those found, in the same order; roll is told best."""
    if face.pose is None:
        return True
    apart = np.abs((pose - face.pose + 180) % 360 - 180)[1:]
    return bool((np.isnan(apart) | (apart <= _DISAGREE)).all())


@jax.jit
def _align(
    model: ActiveShapeModel, points: Float[Array, "faces landmarks 2"], weights: Float[Array, "faces landmarks"]
) -> tuple[Float[Array, "faces landmarks 2"], Float[Array, "faces 3"], Bool[Array, "faces"], Bool[Array, "faces"]]:
    """All points where they are seen, poses in degrees, whether the known points determine them, and are likely."""
    side = jnp.ptp(model.mean, 0).max()
    radius = likely_radius(len(model.deviations))

    def one(points: Landmarks, weights: Weights) -> tuple[Landmarks, Array, Array, Array]:
        b, camera, error, _ = align_head(model, points, weights)
        shown = show(model.reconstruct(b), camera)[:, :2]
        near = error <= _WORST * side * camera.scale * weights.sum()
        # A mirrored face, its left taken for its right, is one seen from behind.
        ahead = camera.rotation[2, 2] > _BEHIND
        likely = near & ahead & (jnp.sum((b / model.deviations) ** 2) <= radius**2)
        return shown, pose_degrees(*rotation_angles(camera.rotation)), camera.ok, likely

    return jax.vmap(one)(points, weights)
