"""AFLW2000's MATLAB files, from written ones with known faces, and the meaning of the real ones' angles."""

import math

import numpy as np
import pytest
from pose_signs import correlation, depth_below_the_eyes
from scipy.io import loadmat
from scipy.spatial.transform import Rotation
from written_labels import AFLW2000_POINTS, write_aflw2000_face

from jaxfit.errors import DatasetError, InputError
from jaxfit.labels.datasets import read_dataset
from jaxfit.labels.importers.aflw2000 import read_aflw2000


def test_a_face(tmp_path):
    write_aflw2000_face(tmp_path)
    dataset = read_aflw2000(tmp_path)
    (face,) = dataset.faces
    np.testing.assert_array_equal(face.landmarks, AFLW2000_POINTS[:2].T - 1)
    np.testing.assert_allclose(face.pose, np.degrees([0.3, 0.1, 0.2]), rtol=1e-6)
    assert face.landmarks.dtype == face.pose.dtype == np.float64
    assert face.pose_order == "roll-yaw-pitch"
    assert face.complete
    assert face.visible.all()
    assert face.box is None
    assert (face.image, face.subject, face.face) == (tmp_path / "image1.jpg", "image1", "image1")
    assert (dataset.scheme.name, dataset.problems) == ("ibug68", ())


def test_large_angles_are_left_out_and_counted(tmp_path):
    for axis in range(3):
        for degrees in (-98.5, 98.5, -99.5, 99.5):
            pose = [0.0, 0.0, 0.0]
            pose[axis] = math.radians(degrees)
            write_aflw2000_face(tmp_path, f"axis{axis}_{degrees}", pose=pose)
    usual, everything = read_dataset(f"aflw2000:{tmp_path}"), read_dataset(f"aflw2000-all:{tmp_path}")
    assert [np.abs(face.pose).max().round(2) for face in usual.faces] == [98.5] * 6
    assert usual.problems == ("6 of 12 faces left out: an angle over 99 degrees (aflw2000-all keeps them)",)
    assert len(everything.faces) == 12
    assert everything.problems == ()
    with pytest.raises(DatasetError, match="none that can be used; first problem: 12 of 12 faces left out"):
        read_aflw2000(tmp_path, most_degrees=10.0)
    for wrong in (0.0, -99.0, math.nan):
        with pytest.raises(InputError, match="most_degrees"):
            read_aflw2000(tmp_path, most_degrees=wrong)


def test_landmarks_that_were_annotated_again_are_those_of_the_same_face(tmp_path):
    shifted = AFLW2000_POINTS.astype(np.float32) + np.float32(3)
    write_aflw2000_face(tmp_path, "first", pose=[3.0, 0, 0])
    write_aflw2000_face(tmp_path, "second", pt3d_68=shifted.astype(np.float64))
    again = np.random.default_rng(0).uniform(0, 450, (3, 2, 68)).astype(np.float32)
    own = np.stack([shifted, np.zeros((3, 68), np.float32), AFLW2000_POINTS.astype(np.float32)])
    np.save(tmp_path / "AFLW2000-3D.pts68.npy", own)
    np.save(tmp_path / "AFLW2000-3D-Reannotated.pts68.npy", again)
    dataset = read_dataset(f"aflw2000-re:{tmp_path}")
    assert [face.face for face in dataset.faces] == ["first", "second"]  # whatever their angles
    for face, row in zip(dataset.faces, (2, 0), strict=True):
        np.testing.assert_array_equal(face.landmarks, again[row].T)
    np.save(tmp_path / "AFLW2000-3D.pts68.npy", own[1:])
    with pytest.raises(DatasetError, match=r"as many faces in .*; got 2 and 3"):
        read_dataset(f"aflw2000-re:{tmp_path}")
    np.save(tmp_path / "AFLW2000-3D.pts68.npy", own[[1, 1, 2]])
    assert "second.jpg: its landmarks are not among" in read_dataset(f"aflw2000-re:{tmp_path}").problems[0]
    (tmp_path / "AFLW2000-3D-Reannotated.pts68.npy").write_bytes(b"nothing")
    with pytest.raises(DatasetError, match=r"Reannotated.pts68.npy: expected the landmarks of AFLW2000-3D as an array"):
        read_dataset(f"aflw2000-re:{tmp_path}")


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"Pose_Para": None}, r"numbers Pose_Para \(1, 7\), found none"),
        ({"Pose_Para": np.full((1, 7), np.nan)}, r"Pose_Para \(1, 7\), found float64 \(1, 7\)"),
        ({"Pose_Para": np.zeros((1, 6))}, r"Pose_Para \(1, 7\), found float64 \(1, 6\)"),
        ({"Pose_Para": np.zeros((1, 7), complex)}, r"Pose_Para \(1, 7\), found none"),
        ({"pt3d_68": None}, r"pt3d_68 \(3, 68\), found none"),
        ({"pt3d_68": AFLW2000_POINTS.T}, r"pt3d_68 \(3, 68\), found float64 \(68, 3\)"),
        ({"pt3d_68": AFLW2000_POINTS.astype(object)}, r"pt3d_68 \(3, 68\), found none"),
        ({"pt3d_68": "seven"}, r"pt3d_68 \(3, 68\), found none"),
    ],
)
def test_files_without_the_expected_numbers_become_problems(tmp_path, changed, reason):
    write_aflw2000_face(tmp_path, "image1", **changed)
    with pytest.raises(DatasetError, match=reason):
        read_aflw2000(tmp_path)
    write_aflw2000_face(tmp_path, "image2")
    dataset = read_aflw2000(tmp_path)
    assert [face.face for face in dataset.faces] == ["image2"]
    assert len(dataset.problems) == 1
    assert "image1.mat" in dataset.problems[0]


def test_damaged_files_become_problems(tmp_path):
    write_aflw2000_face(tmp_path, "image1")
    (tmp_path / "image2.mat").write_bytes((tmp_path / "image1.mat").read_bytes()[:-9])
    (tmp_path / "image3.mat").write_bytes(b"")
    dataset = read_aflw2000(tmp_path)
    assert [face.face for face in dataset.faces] == ["image1"]
    for stem, problem in zip(("image2", "image3"), dataset.problems, strict=True):
        assert f"{stem}.mat: cannot be read" in problem


def test_folders_without_faces(tmp_path):
    with pytest.raises(DatasetError, match=r"none that can be used$"):
        read_aflw2000(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match=r"expected a folder of AFLW2000's \.mat files"):
        read_aflw2000(tmp_path / "file")


def test_the_real_dataset(real_dataset):
    usual, everything = (real_dataset(f"{name}:aflw2000") for name in ("aflw2000", "aflw2000-all"))
    assert len(everything.faces) == 628 == len({face.face for face in everything.faces})
    assert everything.problems == ()
    assert usual.problems == ("10 of 628 faces left out: an angle over 99 degrees (aflw2000-all keeps them)",)
    assert len(usual.faces) == 618
    assert all(face.image.is_file() and face.complete for face in everything.faces)


def test_pose_signs_agree_with_the_landmarks(real_dataset):
    """The eye line gives the roll, the nose before the ears the yaw, the nose and the ears below the eyes the pitch."""
    faces = real_dataset("aflw2000:aflw2000").faces
    landmarks = np.array([face.landmarks for face in faces])
    roll, pitch, yaw = np.array([face.pose for face in faces]).T
    left, right, mouth = (landmarks[:, part].mean(1) for part in (slice(36, 42), slice(42, 48), slice(48, 60)))
    nose, ears = landmarks[:, 30], (landmarks[:, 0] + landmarks[:, 16]) / 2
    line, turned = right - left, np.abs(yaw)
    assert correlation(roll, np.degrees(np.arctan2(line[:, 1], line[:, 0])), turned < 45) > 0.9
    assert correlation(yaw, (nose - ears)[:, 0] / np.ptp(landmarks, axis=1).max(1), turned < 99) < -0.95
    assert correlation(pitch, depth_below_the_eyes(nose, left, right, mouth), turned < 15) < -0.75
    assert correlation(pitch, depth_below_the_eyes(ears, left, right, mouth), turned < 15) > 0.75


def test_pose_order_agrees_with_the_rotations_of_the_points(real_dataset):
    """The angles are those of the rotation that takes an upright head to the face's 3D points, in their order."""
    faces = real_dataset("aflw2000:aflw2000").faces
    solid = [loadmat(face.image.with_suffix(".mat"))["pt3d_68"].T * [1, 1, -1] for face in faces]  # z was to the viewer
    solid = np.array([(points - points.mean(0)) / points.std() for points in solid])
    roll, pitch, yaw = pose = np.array([face.pose for face in faces]).T
    head = solid[(np.abs(pose) < 4).all(0)].mean(0)
    rotations = Rotation.concatenate([Rotation.align_vectors(points, head)[0] for points in solid])
    turned = np.abs(yaw) > 30

    def distances(order, angles):
        """Median distance between ``angles`` and those of the rotations about moving axes, in ``order``, each."""
        apart = rotations.as_euler(order, degrees=True) - np.stack(angles, 1)
        return np.median(np.abs((apart + 180) % 360 - 180)[turned], 0)

    own_order = distances("XYZ", [-pitch, yaw, roll])
    assert (own_order < 4).all()
    yaw_first, pitch_first, roll_first = distances("YXZ", [yaw, -pitch, roll])  # Eq. 15
    assert (2 * own_order < [pitch_first, yaw_first, roll_first]).all()
