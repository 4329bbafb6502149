"""Labels of one landmark scheme, some of them missing, as complete labels of another: through a 3D head model.

Visible points of a turned face give its camera and shape, and with them the points that are hidden or not labelled.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxfit.aligning import align_labels
from jaxfit.data.records import FaceRecord
from jaxfit.evaluation.pose import in_order
from jaxfit.models.heads import HeadModel
from jaxfit.shapes.asm import likely_radius
from jaxfit.shapes.schemes import Scheme

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

    All of them are where the head model has them, those that were labelled, too: nearby, not quite the same.

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
    labels = np.where(known[..., None], labels, np.nan)
    found = align_labels(model, np.pad(labels, ((0, 0), (0, target.count), (0, 0)), constant_values=np.nan))
    enough = found.ok & (known.sum(1) >= _FEWEST)
    # A mirrored face, its left taken for its right, is one seen from behind.
    _, pitch, yaw = np.radians(found.pose).T
    ahead = np.cos(pitch) * np.cos(yaw) > _BEHIND
    spread = (found.b / np.asarray(model.deviations)) ** 2
    likely = (found.error <= _WORST) & ahead & (spread.sum(1) <= likely_radius(len(model.deviations)) ** 2)
    comparable = in_order(found.pose, [face.pose_order for face in faces])
    agree = np.array([_agree(face, pose) for face, pose in zip(faces, comparable, strict=True)], bool)
    turned = np.abs(found.pose[:, 2]) >= least_yaw
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
            landmarks=found.landmarks[n, source.count :, :2],
            present=present,
            visible=present.copy(),
            pose=found.pose[n],
            pose_order="roll-pitch-yaw",
        )
        for n in map(int, np.flatnonzero(kept))
    ]
    return Lifted(tuple(lifted), tuple(problems))


def fill_labels(faces: Sequence[FaceRecord], scheme: Scheme, head: HeadModel) -> Lifted:
    """The missing landmarks of faces, from where a head model has them; those that are labelled stay as they are.

    Left out are incomplete faces that `lift_labels` leaves out.

    Args:
        faces: labelled faces.
        scheme: what their landmarks mean.
        head: has these points.

    Raises:
        InputError: the head model lacks the scheme.
    """
    lifted = lift_labels([face for face in faces if not face.complete], scheme, scheme, head)
    filled = {(face.image, face.face): face for face in lifted.faces}
    whole = []
    for face in faces:
        if face.complete:
            whole.append(face)
        elif other := filled.get((face.image, face.face)):
            whole.append(replace(other, landmarks=np.where(face.present[:, None], face.landmarks, other.landmarks)))
    return Lifted(tuple(whole), lifted.problems)


def _agree(face: FaceRecord, pose: np.ndarray) -> bool:
    """Whether the labelled pitch and yaw, if known, are near those found, in the same order; roll is told best."""
    if face.pose is None:
        return True
    apart = np.abs((pose - face.pose + 180) % 360 - 180)[1:]
    return bool((np.isnan(apart) | (apart <= _DISAGREE)).all())
