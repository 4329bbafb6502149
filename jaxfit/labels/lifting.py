"""Labels of one landmark scheme, some of them missing, as complete labels of another: through a 3D head model.

Visible points of a turned face give its camera and shape, and with them the points that are hidden or not labelled.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jaxfit.heads.model import HeadModel
from jaxfit.labels.aligned import align_labels
from jaxfit.labels.records import FaceRecord
from jaxfit.schemes.conversions import sources
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.asm import likely_radius
from jaxfit.shapes.pose_order import in_order

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
# Centimetres between points of two schemes on the mean head; farther ones, such as ears, stand in for each other.
_SAME = 2.0


@dataclass(frozen=True)
class Lifted:
    """Faces with labels of another scheme.

    Attributes:
        faces: the faces, with all landmarks of the target scheme, in the order of the given ones; which of them are
            hidden is unknown, and ``visible`` all of ``present``.
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
    found = _explained(faces, source, target, head, least_yaw)
    present = np.ones(target.count, bool)
    lifted = [
        replace(
            faces[n],
            landmarks=found.target[n],
            present=present,
            visible=present.copy(),
            pose=found.pose[n],
            pose_order="roll-pitch-yaw",
        )
        for n in found.kept
    ]
    return Lifted(tuple(lifted), found.problems)


def share_labels(
    faces: Sequence[FaceRecord], source: Scheme, target: Scheme, head: HeadModel, least_yaw: float = 0.0
) -> Lifted:
    """Those labels of ``target`` that faces labelled with (some of) ``source`` really have.

    Labels that conversion (`jaxfit.convert_dataset`) takes from a single point, and that are near it on the mean head,
    are that point's, moved by as much as both differ on the head model. Only they are ``present``; all others are where
    `lift_labels` has them. The same faces are left out. What a face's labels lack though their scheme has it is not
    ``visible``; whether points can be seen that the schemes do not share is unknown: they are neither ``present`` nor
    hidden.

    Args:
        faces: labelled faces.
        source: what their landmarks mean.
        target: what the new ones shall mean.
        head: has the points of both.
        least_yaw: as in `lift_labels`.

    Raises:
        InputError: the head model lacks one of the schemes, or no conversion to ``source`` is known.
    """
    found = _explained(faces, source, target, head, least_yaw)
    both = head.of_points([*head.indices(source), *head.indices(target)], _VARIANCE)
    of_source, of_target = np.split(np.asarray(both.mean), [source.count])
    single = [(own, of[0]) for own, of in enumerate(sources(target, source)) if len(of) == 1]
    pairs = [(own, of) for own, of in single if np.linalg.norm(of_source[own] - of_target[of]) < _SAME]
    own, other = map(np.array, zip(*pairs, strict=True))
    made_of = sources(target, source)
    shared = []
    for n in found.kept:
        landmarks, present = found.target[n].copy(), np.zeros(target.count, bool)
        present[other] = faces[n].known[own]
        moved = landmarks[other] + faces[n].landmarks[own] - found.source[n][own]
        landmarks[other] = np.where(present[other, None], moved, landmarks[other])
        visible = np.ones(target.count, bool)
        for points, seen in zip(made_of, faces[n].known & faces[n].visible, strict=True):
            if not seen:
                visible[list(points)] = False
        shared.append(replace(faces[n], landmarks=landmarks, present=present, visible=visible))
    return Lifted(tuple(shared), found.problems)


class _Explained(NamedTuple):
    """What a head model makes of N faces.

    Attributes:
        source: (N, L, 2) their landmarks, where it has them.
        target: (N, M, 2) those of another scheme.
        pose: (N, 3) roll, pitch and yaw in degrees.
        kept: the numbers of those that it explains.
        problems: how many others there are and why, a sentence each.
    """

    source: np.ndarray
    target: np.ndarray
    pose: np.ndarray
    kept: list[int]
    problems: tuple[str, ...]


def _explained(
    faces: Sequence[FaceRecord], source: Scheme, target: Scheme, head: HeadModel, least_yaw: float
) -> _Explained:
    given, wanted = head.indices(source), head.indices(target)
    model = head.of_points([*given, *wanted], _VARIANCE)
    known = np.array([face.known for face in faces]).reshape(-1, source.count)
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
        (agree, f"their points show a pose more than {_DISAGREE:.0f} degrees from the labelled one"),
        (turned, f"turned by less than {least_yaw:g} degrees"),
    ):
        if dropped := int((kept & ~good).sum()):
            problems.append(f"{dropped} of {len(faces)} faces left out: {why}")
        kept &= good
    points = found.landmarks[..., :2]
    numbers = list(map(int, np.flatnonzero(kept)))
    return _Explained(points[:, : source.count], points[:, source.count :], found.pose, numbers, tuple(problems))


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
            whole.append(replace(other, landmarks=np.where(face.known[:, None], face.landmarks, other.landmarks)))
    return Lifted(tuple(whole), lifted.problems)


def _agree(face: FaceRecord, pose: np.ndarray) -> bool:
    """Whether the labelled pitch and yaw, if known, are near those found, in the same order; roll is known best."""
    if face.pose is None:
        return True
    apart = np.abs((pose - face.pose + 180) % 360 - 180)[1:]
    return bool((np.isnan(apart) | (apart <= _DISAGREE)).all())
