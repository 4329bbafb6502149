"""iBUG's annotations: what is written is read, and what is wrong is said."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxfit.data.pictures import read_image
from jaxfit.data.pts import read_pts, write_pts
from jaxfit.errors import DatasetError, ImageError, InputError
from jaxfit.labels.importers.pts_folder import read_pts_folder

POINTS = np.array([[0.0, 0.0], [10.5, -3.25], [1234.125, 7.0]])
HEADER = "version: 1\nn_points: 2\n{\n1 2\n3 4.5\n}\n"


def add_face(folder, stem, count=3, picture=".jpg"):
    write_pts(folder / f"{stem}.pts", np.arange(2.0 * count).reshape(count, 2))
    if picture:
        (folder / f"{stem}{picture}").write_bytes(b"not looked at")


@pytest.mark.parametrize("base", [0, 1])
def test_written_points_are_read_back(tmp_path, base):
    write_pts(tmp_path / "a.pts", POINTS, base)
    np.testing.assert_allclose(read_pts(tmp_path / "a.pts", base), POINTS, atol=1e-12)
    assert f"\n{base:.3f} {base:.3f}\n" in (tmp_path / "a.pts").read_text()


@given(arrays(np.float64, (4, 2), elements=st.floats(-1e5, 1e5)), st.sampled_from([0, 1]))
def test_text_survives_reading_and_writing(tmp_path_factory, points, base):
    folder = tmp_path_factory.mktemp("pts")
    write_pts(folder / "a.pts", points, base)
    write_pts(folder / "b.pts", read_pts(folder / "a.pts", base), base)
    assert (folder / "a.pts").read_text() == (folder / "b.pts").read_text()
    np.testing.assert_allclose(read_pts(folder / "a.pts", base), points, atol=0.000501)


def test_points_that_are_missing(tmp_path):
    add_face(tmp_path, "a", 4)
    (tmp_path / "a.pts").write_text("1 2\nnan nan\n3 4\nNaN NaN\n")
    (face,) = read_pts_folder(tmp_path).faces
    np.testing.assert_array_equal(face.landmarks, [[0, 1], [np.nan, np.nan], [2, 3], [np.nan, np.nan]])
    np.testing.assert_array_equal(face.present, [True, False, True, False])
    assert not face.complete


@pytest.mark.parametrize(
    "text",
    [
        HEADER,
        HEADER.replace("\n", "\r\n"),
        "\ufeff" + HEADER,
        "version:1\nN_POINTS : 2\n{\n\n 1\t2 \n3 4.5\n}",
        "1 2\n3 4.5\n",
        "1.0 2.0\n3e0 4.5",
    ],
)
def test_spellings_of_the_same_points(tmp_path, text):
    (tmp_path / "a.pts").write_bytes(text.encode())
    np.testing.assert_array_equal(read_pts(tmp_path / "a.pts"), [[0, 1], [2, 3.5]])
    np.testing.assert_array_equal(read_pts(tmp_path / "a.pts", base=0), [[1, 2], [3, 4.5]])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (HEADER.replace("n_points: 2", "n_points: 3"), "says n_points: 3 but lists 2"),
        (HEADER.replace("3 4.5", "3 four"), "line 5.*'3 four'"),
        (HEADER.replace("3 4.5", "3"), "line 5"),
        (HEADER.replace("3 4.5", "nan 1"), "line 5.*finite"),
        ("nan nan\nnan nan\n", "none that is not missing"),
        (HEADER.replace("3 4.5", "1 inf"), "line 5.*finite"),
        ("version: 1\nn_points: 0\n{\n}\n", "no points"),
        ("", "no points"),
    ],
)
def test_damaged_files_are_refused_with_the_place(tmp_path, text, reason):
    (tmp_path / "a.pts").write_text(text)
    with pytest.raises(DatasetError, match=reason):
        read_pts(tmp_path / "a.pts")


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(DatasetError, match=r"a\.pts.*No such file"):
        read_pts(tmp_path / "a.pts")
    (tmp_path / "a.pts").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(DatasetError, match="not UTF-8"):
        read_pts(tmp_path / "a.pts")


def test_wrong_arguments(tmp_path):
    with pytest.raises(InputError, match="0 or 1"):
        read_pts(tmp_path / "a.pts", base=2)
    with pytest.raises(InputError, match="finite"):
        write_pts(tmp_path / "a.pts", np.full((3, 2), np.nan))
    with pytest.raises(InputError, match=r"\(3, 3\)"):
        write_pts(tmp_path / "a.pts", np.zeros((3, 3)))
    assert not list(tmp_path.iterdir())


def test_a_folder_gives_faces_by_name_and_subjects_by_number(tmp_path):
    for stem in ("b_01", "b_2", "image_0001", "a", "x_123", "_1", "c_1_2"):
        add_face(tmp_path, stem)
    dataset = read_pts_folder(tmp_path)
    assert [face.face for face in dataset.faces] == ["_1", "a", "b_01", "b_2", "c_1_2", "image_0001", "x_123"]
    assert [face.subject for face in dataset.faces] == ["_1", "a", "b", "b", "c_1", "image_0001", "x_123"]
    assert dataset.problems == ()
    assert dataset.scheme.name == "points3"
    assert all(face.complete and face.visible.all() and face.image.exists() for face in dataset.faces)


def test_a_point_in_the_corner_is_a_point(tmp_path):
    add_face(tmp_path, "a")
    write_pts(tmp_path / "a.pts", POINTS)
    (face,) = read_pts_folder(tmp_path).faces
    np.testing.assert_array_equal(face.landmarks[0], [0, 0])
    assert face.present.all()


def test_bases_are_one_pixel_apart(tmp_path):
    add_face(tmp_path, "a")
    (one,), (zero,) = read_pts_folder(tmp_path).faces, read_pts_folder(tmp_path, base=0).faces
    np.testing.assert_array_equal(zero.landmarks - one.landmarks, 1)


def test_pictures_have_any_of_the_endings_in_any_case(tmp_path):
    endings = [".jpg", ".JPEG", ".Png", ".bmp", ".tif", ".TIFF", ".webp"]
    for index, ending in enumerate(endings):
        add_face(tmp_path, f"face{index}a", picture=ending)
    (tmp_path / "face0a.pts").rename(tmp_path / "face0a.PTS")
    assert [face.image.suffix for face in read_pts_folder(tmp_path).faces] == endings


def test_files_that_cannot_be_used_become_problems(tmp_path):
    for stem in ("a", "b"):
        add_face(tmp_path, stem)
    add_face(tmp_path, "other-count", count=4)
    add_face(tmp_path, "damaged")
    (tmp_path / "damaged.pts").write_text("not points")
    dataset = read_pts_folder(tmp_path)
    assert [face.face for face in dataset.faces] == ["a", "b"]
    for stem in ("other-count", "damaged"):
        assert sum(stem in problem for problem in dataset.problems) == 1
    assert len(dataset.problems) == 2


def test_a_face_without_its_picture_stays_a_face(tmp_path):
    add_face(tmp_path, "a")
    add_face(tmp_path, "no.picture", picture="")
    dataset = read_pts_folder(tmp_path)
    assert [face.face for face in dataset.faces] == ["a", "no.picture"]
    assert dataset.problems == ()
    with pytest.raises(ImageError, match=r"no\.picture\.jpg: cannot be read \(No such file"):
        read_image(dataset.faces[1].image)


def test_folders_without_faces(tmp_path):
    with pytest.raises(DatasetError, match="expected a folder"):
        read_pts_folder(tmp_path / "missing")
    with pytest.raises(DatasetError, match=r"expected \.pts files"):
        read_pts_folder(tmp_path)
    (tmp_path / "damaged.pts").write_text("not points")
    with pytest.raises(DatasetError, match=r"first problem: .*damaged"):
        read_pts_folder(tmp_path)
    add_face(tmp_path, "lonely", picture="")
    with pytest.raises(DatasetError, match=r"found none of 1, such as .*lonely\.jpg"):
        read_pts_folder(tmp_path)
