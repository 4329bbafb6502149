"""AFLW's database, from a generated one with known faces."""

import numpy as np
import pytest
from pose_signs import correlation, depth_below_the_eyes
from written_labels import AFLW_POINTS, add_aflw_face, add_aflw_picture, new_aflw

from jaxfit.errors import DatasetError
from jaxfit.labels.importers.aflw import read_aflw


@pytest.fixture(params=[".", "data"])
def aflw(request, tmp_path):
    """The folder that users name, the folder that holds everything, and the open database."""
    folder = tmp_path / request.param
    database = new_aflw(folder)
    add_aflw_picture(database, folder, "p1")
    yield tmp_path, folder, database
    database.close()


def test_a_complete_face(aflw):
    path, folder, database = aflw
    add_aflw_face(database, 7)
    dataset = read_aflw(path)
    (face,) = dataset.faces
    np.testing.assert_array_equal(face.landmarks, AFLW_POINTS)
    np.testing.assert_array_equal(face.box, [-1, 2, 30, 40])
    np.testing.assert_allclose(face.pose, np.degrees([-0.1, 0.2, 0.3]))
    assert face.complete
    assert (face.image, face.face, face.subject) == (folder / "flickr/0/p1", "7", "0/p1")
    assert (dataset.scheme.name, dataset.problems) == ("aflw21", ())


def test_points_without_a_row_are_missing(aflw):
    path, _, database = aflw
    add_aflw_face(database, 1, features=[20, 1, 8])
    (face,) = read_aflw(path).faces
    assert np.flatnonzero(face.present).tolist() == [0, 7, 19]
    np.testing.assert_array_equal(np.isnan(face.landmarks).all(1), ~face.present)
    np.testing.assert_array_equal(face.landmarks[face.present], AFLW_POINTS[[0, 7, 19]])
    assert not face.complete


def test_faces_of_one_picture_share_the_subject_and_come_in_order(aflw):
    path, folder, database = aflw
    add_aflw_picture(database, folder, "p2")
    for face, picture in ((10, "p1"), (9, "p2"), (2, "p1")):
        add_aflw_face(database, face, picture)
    assert [(face.face, face.subject) for face in read_aflw(path).faces] == [
        ("2", "0/p1"),
        ("9", "0/p2"),
        ("10", "0/p1"),
    ]


def test_box_and_pose_may_be_missing(aflw):
    path, _, database = aflw
    add_aflw_face(database, 1)
    database.execute("DELETE FROM FacePose")
    database.execute("UPDATE FaceRect SET w = NULL")
    (face,) = read_aflw(path).faces
    assert face.pose is None
    assert face.box is None


def test_faces_that_cannot_be_used_become_problems(aflw):
    path, _, database = aflw
    add_aflw_face(database, 1)
    add_aflw_face(database, 2, features=[])
    add_aflw_face(database, 4, "unknown")
    dataset = read_aflw(path)
    assert [face.face for face in dataset.faces] == ["1"]
    expected = ("face 2 in 0/p1: no landmarks", "face 4: the database names no picture")
    assert all(part in problem for part, problem in zip(expected, dataset.problems, strict=True))


def test_databases_that_are_not_aflw(aflw):
    path, folder, database = aflw
    with pytest.raises(DatasetError, match="lists no faces"):
        read_aflw(path)
    add_aflw_face(database, 1)
    database.execute("INSERT INTO FeatureCoords VALUES (1, 22, 0, 0)")
    with pytest.raises(DatasetError, match="feature_id 22 of face 1"):
        read_aflw(path)
    database.execute("DROP TABLE FeatureCoords")
    with pytest.raises(DatasetError, match="no such table"):
        read_aflw(path)
    (folder / "aflw.sqlite").write_bytes(b"garbage" * 1000)
    with pytest.raises(DatasetError, match="not a database"):
        read_aflw(path)
    (folder / "aflw.sqlite").unlink()
    with pytest.raises(DatasetError, match="found neither"):
        read_aflw(path)


def test_truncated_database(aflw):
    path, folder, database = aflw
    for face in range(1, 200):
        add_aflw_face(database, face)
    data = (folder / "aflw.sqlite").read_bytes()
    (folder / "aflw.sqlite").write_bytes(data[: len(data) // 2])
    with pytest.raises(DatasetError, match=r"malformed|disk image"):
        read_aflw(path)


def test_a_database_whose_errors_are_no_text(aflw):
    """SQLite quotes what it does not understand, and here that is not UTF-8."""
    folder, home, database = aflw
    add_aflw_face(database, 1)
    database.close()
    file = home / "aflw.sqlite"
    file.write_bytes(file.read_bytes().replace(b"CREATE TABLE FaceRect", b"CREATE TABLE \x89aceR\xeb("))
    with pytest.raises(DatasetError, match="copy it again"):
        read_aflw(folder)


def test_reading_leaves_no_trace(aflw):
    path, folder, database = aflw
    add_aflw_face(database, 1)
    database.close()
    folder.chmod(0o555)
    before = sorted(folder.iterdir())
    read_aflw(path)
    assert sorted(folder.iterdir()) == before
    folder.chmod(0o755)


def test_pose_signs_agree_with_the_landmarks(real_dataset):
    """The eye line gives the roll; along and across it the nose gives the yaw, nose and ears the pitch."""
    faces = real_dataset("aflw:aflw").faces
    landmarks = np.array([face.landmarks for face in faces])
    roll, pitch, yaw = np.array([face.pose for face in faces]).T
    left, right, nose, mouth = (landmarks[:, index] for index in (7, 10, 14, 18))
    ears = (landmarks[:, 12] + landmarks[:, 16]) / 2
    line, middle, turned = right - left, (left + right) / 2, np.abs(yaw)
    assert correlation(roll, np.degrees(np.arctan2(line[:, 1], line[:, 0])), turned < 45) > 0.9
    assert correlation(yaw, ((nose - middle) * line).sum(1) / (line**2).sum(1), turned < 60) < -0.8
    assert correlation(pitch, depth_below_the_eyes(nose, left, right, mouth), turned < 15) < -0.6
    assert correlation(pitch, depth_below_the_eyes(ears, left, right, mouth), turned < 15) > 0.7
    present = np.array([face.present for face in faces])
    assert yaw[~present[:, 12] & present[:, 16]].mean() > 30
    assert yaw[present[:, 12] & ~present[:, 16]].mean() < -30


@pytest.mark.parametrize(
    "table",
    [
        "CREATE VIEW FacePose AS SELECT 1 AS face_id, 0 AS roll, 0 AS pitch, 0 AS yaw",
        "CREATE VIEW FacePose AS WITH RECURSIVE n(face_id) AS (SELECT 1 UNION ALL SELECT face_id + 1 FROM n) "
        "SELECT face_id, 0 AS roll, 0 AS pitch, 0 AS yaw FROM n",
        "CREATE VIRTUAL TABLE FacePose USING fts5(face_id, roll, pitch, yaw)",
        "CREATE TABLE FacePose(face_id, roll AS (zeroblob(1000000000)), pitch, yaw)",
    ],
)
def test_nothing_in_the_database_is_run(aflw, table):
    path, folder, database = aflw
    add_aflw_face(database, 1)
    add_aflw_picture(database, folder, "p1")
    database.execute("DROP TABLE FacePose")
    database.execute(table)
    with pytest.raises(DatasetError, match="FacePose is no plain table of stored values"):
        read_aflw(path)


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("UPDATE FaceImages SET filepath = zeroblob(100000000)", "too big"),
        ("UPDATE FaceImages SET filepath = printf('%.*c', 50000, 'a')", "a text of over 4,096 letters"),
        ("UPDATE FaceImages SET filepath = '../../secret.jpg'", "which is not in flickr"),
        ("UPDATE FaceImages SET filepath = '/etc/secret.jpg'", "which is not in flickr"),
    ],
)
def test_absurd_and_foreign_paths_are_refused(aflw, statement, words):
    path, folder, database = aflw
    add_aflw_face(database, 1)
    add_aflw_picture(database, folder, "p1")
    database.execute(statement)
    with pytest.raises(DatasetError, match=words):
        read_aflw(path)


def test_a_query_ends(aflw, monkeypatch):
    path, folder, database = aflw
    for face in range(300):
        add_aflw_face(database, face)
    add_aflw_picture(database, folder, "p1")
    monkeypatch.setattr("jaxfit.labels.importers.aflw._MOST_SECONDS", -1.0)
    with pytest.raises(DatasetError, match="takes over -1 seconds"):
        read_aflw(path)
