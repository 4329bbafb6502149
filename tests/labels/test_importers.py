"""Laws that every reader of labels keeps."""

from pathlib import Path

import numpy as np
import pytest
from written_labels import WRITE_FACES

from jaxfit.errors import DatasetError
from jaxfit.labels.datasets import FORMATS, FROM_BOTTOM, read_dataset

every_format = pytest.mark.parametrize("name", FORMATS)


def test_no_format_is_left_out() -> None:
    assert WRITE_FACES.keys() == FORMATS.keys()


@every_format
def test_missing_datasets(name: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="missing"):
        read_dataset(f"{name}:{tmp_path / 'missing'}")


@every_format
def test_records_are_whole_and_in_order(name: str, tmp_path: Path) -> None:
    path, names = WRITE_FACES[name](tmp_path, [True] * 3)
    dataset = FORMATS[name](path)
    assert dataset.spec == f"{name}:{path}"
    assert dataset.problems == ()
    assert [face.face for face in dataset.faces] == names
    for face in dataset.faces:
        count = dataset.scheme.count
        assert (face.landmarks.shape, face.landmarks.dtype) == ((count, 2), np.float64)
        np.testing.assert_array_equal(face.present, np.isfinite(face.landmarks).all(1))
        np.testing.assert_array_equal(face.visible, face.present)
        assert face.present.dtype == face.visible.dtype == bool
        assert face.complete == (count > 0)
        assert face.image.is_file()
        assert face.subject
        assert face.box is None or face.box.shape == (4,)
        assert face.pose is None or face.pose.shape == (3,)


@pytest.mark.parametrize("name", FROM_BOTTOM)
def test_what_counts_from_the_bottom_needs_its_picture(name: str, tmp_path: Path) -> None:
    path, names = WRITE_FACES[name](tmp_path, [False, True, False])
    dataset = FORMATS[name](path)
    assert [face.face for face in dataset.faces] == names[1:2]
    np.testing.assert_array_equal(dataset.faces[0].landmarks, [[1, 28], [3, 26]])  # the picture has 30 rows
    assert [problem.split("/")[-1][:6] for problem in dataset.problems if "left out" in problem] == ["p0.png", "p2.png"]


@pytest.mark.parametrize("name", [name for name in FORMATS if name not in FROM_BOTTOM])
def test_a_face_without_its_picture_stays_a_face(name: str, tmp_path: Path) -> None:
    path, names = WRITE_FACES[name](tmp_path, [False, True, False])
    dataset = FORMATS[name](path)
    assert [face.face for face in dataset.faces] == names
    assert [face.image.is_file() for face in dataset.faces] == [False, True, False]
    assert dataset.problems == ()


@every_format
def test_datasets_without_any_picture_are_refused(name: str, tmp_path: Path) -> None:
    path, names = WRITE_FACES[name](tmp_path, [False, False])
    first = "p0" if name == "aflw" else names[0].replace("+", r"\+")
    with pytest.raises(DatasetError, match=rf"found none of 2, such as .*{first}"):
        FORMATS[name](path)
