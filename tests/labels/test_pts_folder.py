"""Folders of iBUG's annotations: which faces they give, and what is reported."""

import numpy as np
import pytest
from written_labels import write_pts_face

from jaxfit.data.pictures import read_image
from jaxfit.data.pts import write_pts
from jaxfit.errors import DatasetError, ImageError
from jaxfit.labels.importers.pts_folder import read_pts_folder


def test_points_that_are_missing(tmp_path):
    write_pts_face(tmp_path, "a", 4)
    (tmp_path / "a.pts").write_text("1 2\nnan nan\n3 4\nNaN NaN\n")
    (face,) = read_pts_folder(tmp_path).faces
    np.testing.assert_array_equal(face.landmarks, [[0, 1], [np.nan, np.nan], [2, 3], [np.nan, np.nan]])
    np.testing.assert_array_equal(face.present, [True, False, True, False])
    assert not face.complete


def test_a_folder_gives_faces_by_name_and_subjects_by_number(tmp_path):
    for stem in ("b_01", "b_2", "image_0001", "a", "x_123", "_1", "c_1_2"):
        write_pts_face(tmp_path, stem)
    dataset = read_pts_folder(tmp_path)
    assert [face.face for face in dataset.faces] == ["_1", "a", "b_01", "b_2", "c_1_2", "image_0001", "x_123"]
    assert [face.subject for face in dataset.faces] == ["_1", "a", "b", "b", "c_1", "image_0001", "x_123"]
    assert dataset.problems == ()
    assert dataset.scheme.name == "points3"
    assert all(face.complete and face.visible.all() and face.image.exists() for face in dataset.faces)


def test_a_point_in_the_corner_is_a_point(tmp_path):
    write_pts_face(tmp_path, "a")
    write_pts(tmp_path / "a.pts", np.array([[0.0, 0.0], [10.5, -3.25], [1234.125, 7.0]]))
    (face,) = read_pts_folder(tmp_path).faces
    np.testing.assert_array_equal(face.landmarks[0], [0, 0])
    assert face.present.all()


def test_bases_are_one_pixel_apart(tmp_path):
    write_pts_face(tmp_path, "a")
    (one,), (zero,) = read_pts_folder(tmp_path).faces, read_pts_folder(tmp_path, base=0).faces
    np.testing.assert_array_equal(zero.landmarks - one.landmarks, 1)


def test_pictures_have_any_of_the_endings_in_any_case(tmp_path):
    endings = [".jpg", ".JPEG", ".Png", ".bmp", ".tif", ".TIFF", ".webp"]
    for index, ending in enumerate(endings):
        write_pts_face(tmp_path, f"face{index}a", picture=ending)
    (tmp_path / "face0a.pts").rename(tmp_path / "face0a.PTS")
    assert [face.image.suffix for face in read_pts_folder(tmp_path).faces] == endings


def test_files_that_cannot_be_used_become_problems(tmp_path):
    for stem in ("a", "b"):
        write_pts_face(tmp_path, stem)
    write_pts_face(tmp_path, "other-count", count=4)
    write_pts_face(tmp_path, "damaged")
    (tmp_path / "damaged.pts").write_text("not points")
    dataset = read_pts_folder(tmp_path)
    assert [face.face for face in dataset.faces] == ["a", "b"]
    for stem in ("other-count", "damaged"):
        assert sum(stem in problem for problem in dataset.problems) == 1
    assert len(dataset.problems) == 2


def test_the_picture_of_a_face_without_one_is_a_jpeg_that_cannot_be_read(tmp_path):
    for stem, picture in (("a", ".jpg"), ("no.picture", "")):
        write_pts_face(tmp_path, stem, picture=picture)
    with pytest.raises(ImageError, match=r"no\.picture\.jpg: cannot be read \(No such file"):
        read_image(read_pts_folder(tmp_path).faces[1].image)


def test_labels_of_faces_that_were_fitted_find_their_picture(tmp_path):
    """``NAME_1.pts`` is what fits write of the first face in ``NAME.jpg``, and the label of ``NAME_1.jpg``."""
    for stem in ("a", "b", "b_1", "c", "c_2", "d_1"):
        write_pts_face(tmp_path, stem)
    for stem in ("a_1", "a_2"):
        write_pts_face(tmp_path, stem, picture="")
    for stem in ("a", "c"):
        (tmp_path / f"{stem}.pts").unlink()
    dataset = read_pts_folder(tmp_path)
    found = {face.face: (face.image.name, face.subject) for face in dataset.faces}
    assert found == {
        "a_1": ("a.jpg", "a"),
        "a_2": ("a.jpg", "a"),
        "b": ("b.jpg", "b"),
        "b_1": ("b_1.jpg", "b"),
        "d_1": ("d_1.jpg", "d"),
    }
    (problem,) = dataset.problems
    assert f"{tmp_path / 'c_2.pts'}: may belong to {tmp_path / 'c_2.jpg'} or" in problem
    assert str(tmp_path / "c.jpg") in problem


def test_folders_without_faces(tmp_path):
    with pytest.raises(DatasetError, match="expected a folder"):
        read_pts_folder(tmp_path / "missing")
    with pytest.raises(DatasetError, match=r"expected \.pts files"):
        read_pts_folder(tmp_path)
    (tmp_path / "damaged.pts").write_text("not points")
    with pytest.raises(DatasetError, match=r"first problem: .*damaged"):
        read_pts_folder(tmp_path)


def test_of_several_pictures_of_a_face_the_first_is_taken_and_said(tmp_path):
    write_pts_face(tmp_path, "a")
    (tmp_path / "a.png").touch()
    dataset = read_pts_folder(tmp_path)
    assert [face.image.name for face in dataset.faces] == ["a.jpg"]
    assert dataset.problems == (f"{tmp_path / 'a.pts'}: a.jpg and a.png have its name; the first is taken",)
