"""LFPW's annotation file, from generated files with known points."""

import random

import numpy as np
import pytest
from written_labels import LFPW_POINTS, lfpw_row, write_lfpw

from jaxfit.errors import DatasetError
from jaxfit.labels.importers.lfpw import read_lfpw


def write(folder, rows, columns=None):
    """With the pictures ``a.jpg`` and ``b.jpg``."""
    for name in "ab":
        (folder / f"{name}.jpg").touch()
    return write_lfpw(folder, rows, columns)


def test_points_and_states(tmp_path):
    states = [index % 4 for index in range(29)]
    dataset = read_lfpw(write(tmp_path, [lfpw_row(states=states)]))
    (face,) = dataset.faces
    np.testing.assert_array_equal(face.landmarks, LFPW_POINTS)
    np.testing.assert_array_equal(face.visible, np.array(states) == 0)
    assert face.complete
    assert dataset.problems == ()
    assert (face.image, face.face, face.subject) == (tmp_path / "a.jpg", "a", "a")


def test_the_order_of_columns_does_not_matter(tmp_path):
    columns = list(lfpw_row())
    random.Random(0).shuffle(columns)
    (face,) = read_lfpw(write(tmp_path, [lfpw_row()], columns)).faces
    np.testing.assert_array_equal(face.landmarks, LFPW_POINTS)


def test_the_average_of_several_workers_counts(tmp_path):
    rows = [
        lfpw_row(worker="w1", chin_x="1"),
        lfpw_row(worker="average"),
        lfpw_row(worker="w2", chin_x="2"),
        lfpw_row("b.jpg", "w1"),
    ]
    dataset = read_lfpw(write(tmp_path, rows))
    assert [face.face for face in dataset.faces] == ["a", "b"]
    np.testing.assert_array_equal(dataset.faces[0].landmarks, LFPW_POINTS)
    assert dataset.problems == ()


def test_two_faces_of_one_picture_stay_apart_but_share_the_subject(tmp_path):
    one, other = read_lfpw(write(tmp_path, [lfpw_row(), lfpw_row(chin_x="1")])).faces
    assert one.face != other.face
    assert one.subject == other.subject


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (lfpw_row("b.jpg", chin_x="x"), "line 3: expected numbers"),
        (lfpw_row("b.jpg", chin_x="1_5"), "line 3: expected numbers"),
        (lfpw_row("b.jpg", chin_x=""), "line 3: expected numbers"),
        (lfpw_row("b.jpg", chin_y="nan"), "line 3: expected finite"),
        (lfpw_row("b.jpg", chin_t="4"), "line 3: expected numbers"),
        (lfpw_row(""), "line 3: the row names no picture"),
        (lfpw_row("."), "line 3: the row names no picture"),
    ],
)
def test_rows_that_cannot_be_used_become_problems(tmp_path, bad, reason):
    dataset = read_lfpw(write(tmp_path, [lfpw_row(), bad]))
    assert [face.face for face in dataset.faces] == ["a"]
    (problem,) = dataset.problems
    assert reason in problem


def test_faces_of_one_file_name_in_two_folders_stay_apart(tmp_path):
    rows = [lfpw_row(), lfpw_row("x/1.jpg"), lfpw_row("y/1.jpg"), lfpw_row("y/1.png")]
    faces = read_lfpw(write(tmp_path, rows)).faces
    assert [face.face for face in faces] == ["a", "x/1", "y/1-4", "y/1-5"]
    assert [face.subject for face in faces] == ["a", "x/1", "y/1", "y/1"]


def test_short_rows_without_a_picture_become_problems(tmp_path):
    columns = sorted(lfpw_row(), key="imgurl".__eq__)
    file = write(tmp_path, [lfpw_row()], columns)
    with file.open("a") as text:
        text.write("1\t2\n3\n")
    dataset = read_lfpw(file)
    assert [face.face for face in dataset.faces] == ["a"]
    assert [problem.split(", ")[1] for problem in dataset.problems] == [
        "line 3: the row names no picture",
        "line 4: the row names no picture",
    ]


def test_short_rows_and_workers_without_average_become_problems(tmp_path):
    file = write(tmp_path, [lfpw_row(), lfpw_row("b.jpg", "w1"), lfpw_row("b.jpg", "w2")])
    with file.open("a") as text:
        text.write("b2.jpg\taverage\t1\nb3.jpg\n")
    dataset = read_lfpw(file)
    assert len(dataset.faces) == 1
    assert ["line 3" in p or "line 4" in p or "line 5" in p or "line 6" in p for p in dataset.problems] == [True] * 4


def test_files_that_are_not_lfpw(tmp_path):
    with pytest.raises(DatasetError, match="No such file"):
        read_lfpw(tmp_path / "lfpw.csv")
    with pytest.raises(DatasetError, match=r"1 missing: chin_t"):
        read_lfpw(write(tmp_path, [lfpw_row()], [name for name in lfpw_row() if name != "chin_t"]))
    (tmp_path / "empty.csv").touch()
    with pytest.raises(DatasetError, match="89 missing"):
        read_lfpw(tmp_path / "empty.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(DatasetError, match="tab-separated"):
        read_lfpw(tmp_path / "binary.csv")
    with pytest.raises(DatasetError, match="no rows"):
        read_lfpw(write(tmp_path, [], list(lfpw_row())))
