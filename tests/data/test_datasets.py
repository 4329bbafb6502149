"""Datasets by name, and the real ones."""

import numpy as np
import pytest

from jaxfit.data.datasets import FORMATS, read_dataset
from jaxfit.data.pts import write_pts
from jaxfit.exceptions import DatasetError, InputError


@pytest.mark.parametrize("spec", ["", "folder", "jpg:folder", "pts", "pts:", ":folder", "PTS:folder"])
def test_wrong_names_are_told_the_formats(spec):
    with pytest.raises(InputError, match="pts, pts0, aflw, lfpw"):
        read_dataset(spec)


@pytest.mark.parametrize("name", FORMATS)
def test_missing_datasets(name, tmp_path):
    with pytest.raises(DatasetError, match="missing"):
        read_dataset(f"{name}:{tmp_path / 'missing'}")


def test_paths_may_have_colons_and_the_name_is_kept(tmp_path):
    folder = tmp_path / "a:b"
    folder.mkdir()
    write_pts(folder / "x.pts", np.array([[1.0, 2.0]]))
    (folder / "x.jpg").touch()
    dataset = read_dataset(f"pts:{folder}/")
    assert dataset.spec == f"pts:{folder}/"
    assert read_dataset(f"pts0:{folder}").faces[0].landmarks.tolist() == [[2.0, 3.0]]


@pytest.mark.parametrize(
    ("spec", "scheme", "faces", "subjects", "complete"),
    [
        ("pts:lfpw68", "ibug68", 805, 805, 805),
        ("pts:helen68", "ibug68", 870, None, 870),
        ("pts:ytf68", "ibug68", 2757, 275, 2757),
        ("aflw:aflw", "aflw21", 3403, None, 1309),
        ("lfpw:lfpw29/kbvt_lfpw_v1.csv", "lfpw29", 121, 121, 121),
    ],
)
def test_the_real_datasets(shared_data, spec, scheme, faces, subjects, complete):
    name, path = spec.split(":")
    dataset = read_dataset(f"{name}:{shared_data / path}")
    assert dataset.scheme.name == scheme
    assert dataset.problems == ()
    assert len(dataset.faces) == faces == len({face.face for face in dataset.faces})
    assert sum(face.complete for face in dataset.faces) == complete
    if subjects:
        assert len({face.subject for face in dataset.faces}) == subjects
