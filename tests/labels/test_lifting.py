"""Labels of one scheme through the head model to another: known heads, what is left out and why, and AFLW."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfit.errors import InputError
from jaxfit.heads.model import load_head_model
from jaxfit.labels.importers.aflw import read_aflw
from jaxfit.labels.lifting import fill_labels, lift_labels, share_labels
from jaxfit.labels.records import FaceRecord
from jaxfit.schemes.known import AFLW21, IBUG68, scheme_named

HEAD = load_head_model()
COUNT = 48  # everywhere the same, which compiles once


def record(number, landmarks, present=None, pose=None, **more):
    present = np.ones(len(landmarks), bool) if present is None else present
    return FaceRecord(
        image=Path(f"{number}.png"),
        landmarks=np.where(present[:, None], landmarks, np.nan),
        present=present,
        visible=present.copy(),
        box=np.array([1.0, 2.0, 3.0, 4.0]),
        pose=pose,
        subject=f"person{number}",
        face=str(number),
        **more,
    )


def turns_of(poses):
    """Eq. 15, by scipy, of reported poses (N, 3)."""
    roll, pitch, yaw = np.transpose(poses)
    return Rotation.from_euler("zxy", np.stack([roll, -pitch, yaw], 1), degrees=True)


@pytest.fixture(scope="module")
def heads():
    """Where likely heads have AFLW's points (N, 21, 2) and iBUG's (N, 68, 2), and their poses (N, 3)."""
    model = HEAD.of_points([*HEAD.indices(AFLW21), *HEAD.indices(IBUG68)], 0.99)
    rng = np.random.default_rng(0)
    b = rng.normal(size=(COUNT, len(model.deviations))) * np.asarray(model.deviations)
    shapes = np.asarray(model.mean) + np.tensordot(b, np.asarray(model.modes), 1)
    poses = rng.uniform([-40, -25, 10], [40, 25, 50], (COUNT, 3))
    poses[::2, 2] *= -1
    seen = np.einsum("nij,nlj->nli", turns_of(poses).as_matrix(), shapes)[..., :2]
    seen = rng.uniform(10, 30, (COUNT, 1, 1)) * seen + 5000
    return seen[:, :21], seen[:, 21:], poses


def lift(faces, **options):
    return lift_labels(faces, AFLW21, IBUG68, HEAD, **options)


def landmarks_of(found):
    return np.array([face.landmarks for face in found.faces])


def distances(found, wanted):
    """Mean distances of points, as shares of the face."""
    return np.linalg.norm(found - wanted, axis=2).mean(1) / np.ptp(wanted, 1).max(1)


def test_complete_labels_give_the_points_of_the_other_scheme(heads):
    given, wanted, poses = heads
    found = lift([record(n, points, pose=pose) for n, (points, pose) in enumerate(zip(given, poses, strict=True))])
    assert found.problems == ()
    landmarks = landmarks_of(found)
    assert distances(landmarks, wanted).max() < 0.03
    # Points that both schemes have are where they were.
    own, other = [36, 45, 48, 54, 8], [6, 11, 17, 19, 20]
    assert distances(landmarks[:, own], given[:, other]).max() < 0.01


def test_shared_points_are_labelled_and_the_others_guessed(heads):
    given, wanted, _ = heads
    hidden = np.arange(21) == 8  # an inner corner of an eye
    faces = [record(n, points, ~hidden if n % 2 else None) for n, points in enumerate(given)]
    shared, lifted = share_labels(faces, AFLW21, IBUG68, HEAD), lift(faces)
    assert shared.problems == lifted.problems == ()
    same = [17, 19, 21, 22, 24, 26, 36, 39, 42, 45, 31, 30, 35, 48, 54, 8]
    for number, (face, other) in enumerate(zip(shared.faces, lifted.faces, strict=True)):
        assert set(np.flatnonzero(face.present)) == set(same) - ({39} if number % 2 else set())
        np.testing.assert_array_equal(face.landmarks[~face.present], other.landmarks[~face.present])
    # As exact as the labels, where both schemes have the same points.
    exact = [36, 42, 45, 30, 48, 54, 8]
    np.testing.assert_allclose(landmarks_of(shared)[:, exact], wanted[:, exact], atol=1e-2)
    assert distances(landmarks_of(shared)[:, same], wanted[:, same]).max() < 0.01


def test_labels_move_the_points_that_they_share(heads):
    given, _, _ = heads
    moved = given.copy()
    moved[:, 6] += [3.0, 0.0]  # the outer corner of an eye
    before, after = (
        landmarks_of(share_labels([record(n, points) for n, points in enumerate(faces)], AFLW21, IBUG68, HEAD))
        for faces in (given, moved)
    )
    np.testing.assert_allclose((after - before)[:, 36], np.tile([3.0, 0.0], (COUNT, 1)), atol=0.05)


def test_schemes_without_a_conversion_share_nothing(heads):
    with pytest.raises(InputError, match="cannot convert landmarks from aflw21 to ibug68"):
        share_labels([record(n, points) for n, points in enumerate(heads[1])], IBUG68, AFLW21, HEAD)


def test_half_of_the_labels_are_enough(heads):
    given, wanted, poses = heads
    # Of a turned head, one side is hidden: the nose goes left where the right side is seen.
    across = np.asarray(HEAD.of(AFLW21, 0.9).mean)[:, 0]
    seen = np.sign(poses[:, 2:]) * across > -0.5
    assert ((seen.sum(1) >= 11) & (seen.sum(1) <= 13)).all()
    faces = [record(n, points, present) for n, (points, present) in enumerate(zip(given, seen, strict=True))]
    found = lift(faces)
    assert found.problems == ()
    landmarks = landmarks_of(found)
    assert np.median(distances(landmarks, wanted)) < 0.03
    assert distances(landmarks, wanted).max() < 0.1
    # What stands where a label is missing says nothing.
    nonsense = [replace(face, landmarks=np.nan_to_num(face.landmarks, nan=-77.0)) for face in faces]
    np.testing.assert_array_equal(landmarks_of(lift(nonsense)), landmarks)


def test_records_keep_who_they_are_and_become_complete(heads):
    given, _, poses = heads
    found = lift([record(n, given[n], pose=poses[n] + [0, 5, -5]) for n in range(COUNT)])
    for number, face in enumerate(found.faces):
        assert face.complete
        assert face.landmarks.shape == (68, 2)
        assert face.landmarks.dtype == face.pose.dtype == np.float64
        assert np.isfinite(face.landmarks).all()
        assert face.visible.all()
        assert (face.image, face.subject, face.face) == (Path(f"{number}.png"), f"person{number}", str(number))
        np.testing.assert_array_equal(face.box, [1, 2, 3, 4])
        assert face.pose_order == "roll-pitch-yaw"
    # The pose is what the points tell, not the labelled one.
    assert np.median(np.abs([face.pose for face in found.faces] - poses), 0).max() < 2


def test_each_reason_to_leave_a_face_out_is_counted(heads):
    given, _, poses = heads
    few, eight = (np.arange(21) >= 21 - count for count in (7, 8))
    faces = [record(n, points) for n, points in enumerate(given)]
    faces[0] = record(0, given[0], few)
    faces[1] = record(1, np.outer(np.arange(21), [3, 2]))
    faces[2] = record(2, np.full((21, 2), 50.0))
    faces[3] = record(3, np.full((21, 2), np.nan), np.zeros(21, bool))
    faces[4] = record(4, given[4, np.random.default_rng(2).permutation(21)])
    faces[5] = record(5, given[5], pose=poses[5] + [0, 25, 0])
    faces[6] = record(6, given[6], pose=poses[6] + [0, 0, -25])
    faces[7] = record(7, given[7], pose=poses[7] + [90, 10, 10])  # roll is not asked
    faces[8] = record(8, given[8], pose=np.array([np.nan, poses[8, 1] - 360, np.nan]))
    faces[9] = record(9, given[9], eight)
    found = lift(faces)
    said = [problem.split(f" of {COUNT} faces left out: ") for problem in found.problems]
    assert [number for number, _ in said] == ["4", "1", "2"]
    assert "fewer than 8 labelled points" in said[0][1]
    assert "not where those of a face can be" in said[1][1]
    assert "more than 20 degrees" in said[2][1]
    assert [face.face for face in found.faces] == [str(number) for number in range(7, COUNT)]


def test_faces_may_have_to_be_turned(heads):
    given, _, poses = heads
    found = lift([record(n, points) for n, points in enumerate(given)], least_yaw=30.0)
    kept = {int(face.face) for face in found.faces}
    assert kept >= set(np.flatnonzero(np.abs(poses[:, 2]) > 35))
    assert not kept & set(np.flatnonzero(np.abs(poses[:, 2]) < 25))
    assert found.problems == (f"{COUNT - len(kept)} of {COUNT} faces left out: turned by less than 30 degrees",)


def test_missing_labels_are_filled_and_the_others_stay(heads):
    given, _, poses = heads
    present = np.arange(21) % 3 > 0
    faces = [record(n, points, present if n % 2 else None, poses[n]) for n, points in enumerate(given)]
    faces[3] = record(3, given[3], np.arange(21) < 7)
    found = fill_labels(faces, AFLW21, HEAD)
    assert [face.face for face in found.faces] == [str(n) for n in range(COUNT) if n != 3]
    assert found.problems == (f"1 of {COUNT // 2} faces left out: fewer than 8 labelled points, or all on a line",)
    for face in found.faces:
        number = int(face.face)
        assert face.complete
        np.testing.assert_array_equal(face.landmarks[present], given[number][present])
        if number % 2 == 0:
            assert face is faces[number]
    assert np.median(distances(landmarks_of(found), given[[int(face.face) for face in found.faces]])[1::2]) < 0.02


def test_labelled_poses_may_be_in_another_order(heads):
    given, _, poses = heads
    pitch, yaw, roll = turns_of(poses).as_euler("XYZ", degrees=True).T * [[-1], [1], [1]]
    others = np.stack([roll, pitch, yaw], 1)
    apart = others - poses
    # Labels that are not exact: in their own order still near, but not in Eq. 15's.
    others[:, 1] += 16 * np.sign(apart[:, 1])
    wrong = np.abs(apart[:, 1]) > 6
    assert wrong.any()
    found = lift([record(n, given[n], pose=others[n], pose_order="roll-yaw-pitch") for n in range(COUNT)])
    assert found.problems == ()
    found = lift([record(n, given[n], pose=others[n]) for n in range(COUNT)])
    assert not {int(face.face) for face in found.faces} & set(np.flatnonzero(wrong))


def test_no_faces():
    found = lift([])
    assert (found.faces, found.problems) == ((), ())


def test_schemes_that_the_head_lacks():
    for schemes in ((AFLW21, scheme_named("points5")), (scheme_named("points5"), IBUG68)):
        with pytest.raises(InputError, match="no points of scheme points5"):
            lift_labels([], *schemes, HEAD)


def test_aflw(shared_data):
    """Poses of AFLW's complete labels are those that AFLW tells, which a 3D model of theirs was fitted for."""
    if not (shared_data / "aflw" / "data" / "aflw.sqlite").is_file():
        pytest.skip("needs AFLW")
    complete = [face for face in read_aflw(shared_data / "aflw").faces if face.complete and face.pose is not None]
    faces = complete[:: len(complete) // COUNT][:COUNT]
    found = lift(faces)
    assert len(found.faces) > 0.85 * COUNT
    labelled = {face.face: face.pose for face in faces}
    apart = np.array([face.pose - labelled[face.face] for face in found.faces])
    assert (np.median(np.abs((apart + 180) % 360 - 180), 0) < 6).all()
