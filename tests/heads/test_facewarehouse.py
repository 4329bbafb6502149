"""FaceWarehouse's folders, from generated files of its layout with known vertices."""

import struct

import jaxtyping
import numpy as np
import pytest

from jaxfit.errors import DatasetError, InputError
from jaxfit.heads.facewarehouse import read_facewarehouse
from jaxfit.heads.mesh_points import MeshPoints

POINTS = MeshPoints(np.array([[4, 0], [1, 2]]), np.array([[1, 0], [0.5, 0.5]]))
OURS = np.diag([1.0, -1.0, -1.0])  # from y up and z to the viewer


def vertices(tester, shape, count=6):
    return np.random.default_rng([tester, shape]).normal(size=(count, 3)).astype(np.float32)


def write_tester(folder, tester, count=6):
    home = folder / f"Tester_{tester}"
    (home / "Blendshape").mkdir(parents=True)
    (home / "TrainingPose").mkdir()
    for pose in range(20):
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices(tester, pose, count)]
        text = ["# a mesh", *lines, "vt 0.5 0.5", "vn 0 0 1", "f 1/1/1 2/1/1 3/1/1 4/1/1"]
        (home / "TrainingPose" / f"pose_{pose}.obj").write_text("\n".join(text) + "\n")
    shapes = np.stack([vertices(tester, shape, count) for shape in range(47)])
    (home / "Blendshape" / "shape.bs").write_bytes(struct.pack("<3i", 46, count, 9) + shapes.astype("<f4").tobytes())
    return home


def expected(testers, shapes):
    return np.stack([POINTS.at(vertices(tester, shape)) @ OURS for tester in testers for shape in range(shapes)])


@pytest.mark.parametrize(("faces", "shapes"), [("poses", 20), ("blendshapes", 47)])
def test_testers_in_numeric_order(tmp_path, faces, shapes):
    for tester in (10, 2, 1):
        write_tester(tmp_path, tester)
    (tmp_path / "Tester_x").mkdir()
    (tmp_path / "readme.txt").touch()
    heads, problems = read_facewarehouse(tmp_path, POINTS, faces)
    np.testing.assert_allclose(heads, expected([1, 2, 10], shapes), atol=1e-6)
    assert problems == []


def test_a_missing_or_damaged_pose_becomes_a_problem(tmp_path):
    home = write_tester(tmp_path, 1) / "TrainingPose"
    (home / "pose_19.obj").unlink()
    (home / "pose_18.obj").write_text("v 1 2\n")
    (home / "pose_17.obj").write_text("v 1 2 x\n")
    (home / "pose_16.obj").write_text("v 1 2 nan\n" * 6)
    (home / "pose_15.obj").write_text("v 1 2 3\n" * 4)
    (home / "pose_14.obj").write_text("")
    (home / "pose_13.obj").write_bytes(b"v \xff\xff\n")
    (home / "pose_12.obj").write_text("v 1 2 3\nv 1 2\n")
    heads, problems = read_facewarehouse(tmp_path, POINTS)
    np.testing.assert_allclose(heads, expected([1], 12), atol=1e-6)
    assert [problem.split("pose_")[1].split(":")[0] for problem in problems] == [f"{n}.obj" for n in range(12, 20)]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda data: data[:-1], "46 + 1 meshes of 6 vertices"),
        (lambda data: data + b"\0", "46 + 1 meshes of 6 vertices"),
        (lambda data: data[:8], "three counts"),
        (lambda data: b"", "three counts"),
        (lambda data: struct.pack("<3i", 47, 6, 9) + data[12:], "47 + 1 meshes"),
        (lambda data: struct.pack("<3i", 46, 7, 9) + data[12:], "of 7 vertices"),
        (lambda data: struct.pack("<3i", -1, 6, 9), "-1 + 1 meshes"),
        (lambda data: struct.pack("<3i", 46, 0, 9), "of 0 vertices"),
        (lambda data: data[:-4] + struct.pack("<f", np.nan), "finite"),
    ],
)
def test_damaged_blendshapes_become_a_problem(tmp_path, damage, said):
    write_tester(tmp_path, 1)
    file = write_tester(tmp_path, 2) / "Blendshape" / "shape.bs"
    file.write_bytes(damage(file.read_bytes()))
    heads, (problem,) = read_facewarehouse(tmp_path, POINTS, "blendshapes")
    np.testing.assert_allclose(heads, expected([1], 47), atol=1e-6)
    assert str(file) in problem
    assert said in problem


def test_nothing_to_read(tmp_path):
    with pytest.raises(DatasetError, match="No such file"):
        read_facewarehouse(tmp_path / "none", POINTS)
    with pytest.raises(DatasetError, match="Tester_1"):
        read_facewarehouse(tmp_path, POINTS)
    (tmp_path / "Tester_7").mkdir()
    with pytest.raises(DatasetError, match=r"pose_0\.obj"):
        read_facewarehouse(tmp_path, POINTS)


def test_points_of_another_mesh_are_refused(tmp_path):
    write_tester(tmp_path, 1)
    with pytest.raises(DatasetError, match="more than 9 vertices"):
        read_facewarehouse(tmp_path, MeshPoints(np.array([[9]]), np.ones((1, 1))))


def test_other_faces_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(InputError, match="'poses' or 'blendshapes'"):
        read_facewarehouse(tmp_path, POINTS, "expressions")
