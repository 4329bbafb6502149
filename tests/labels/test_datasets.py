"""Datasets by name, and the real ones."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from jaxfit.data.pts import write_pts
from jaxfit.errors import InputError
from jaxfit.labels.datasets import convert_dataset, read_dataset, read_datasets
from jaxfit.labels.records import Dataset, FaceRecord, copies_of
from jaxfit.schemes.known import AFLW21, IBUG68, LFPW29


@pytest.mark.parametrize("spec", ["", "folder", "jpg:folder", "pts", "pts:", ":folder", "PTS:folder"])
def test_wrong_names_are_refused_with_the_formats(spec):
    with pytest.raises(InputError, match="pts, pts0, aflw, lfpw"):
        read_dataset(spec)


def test_paths_may_have_colons_and_the_name_is_kept(tmp_path):
    folder = tmp_path / "a:b"
    folder.mkdir()
    write_pts(folder / "x.pts", np.array([[1.0, 2.0]]))
    (folder / "x.jpg").touch()
    dataset = read_dataset(f"pts:{folder}/")
    assert dataset.spec == f"pts:{folder}/"
    assert read_dataset(f"pts0:{folder}").faces[0].landmarks.tolist() == [[2.0, 3.0]]
    assert read_dataset(f"pts+1:{folder}").faces[0].landmarks.tolist() == [[2.0, 3.0]]
    assert read_dataset(f"pts0-.5:{folder}").faces[0].landmarks.tolist() == [[1.5, 2.5]]


@pytest.mark.parametrize(
    ("spec", "scheme", "faces", "subjects", "complete"),
    [
        ("pts:lfpw68", "ibug68", 805, 805, 805),
        ("pts:helen68", "ibug68", 870, None, 870),
        ("pts:ytf68", "ibug68", 2757, 275, 2757),
        ("aflw:aflw", "aflw21", 15461, None, 1309),
        ("lfpw:lfpw29/kbvt_lfpw_v1.csv", "lfpw29", 121, 121, 121),
    ],
)
def test_the_real_datasets(real_dataset, spec, scheme, faces, subjects, complete):
    dataset = real_dataset(spec)
    assert dataset.scheme.name == scheme
    assert dataset.problems == ()
    assert len(dataset.faces) == faces == len({face.face for face in dataset.faces})
    assert sum(face.complete for face in dataset.faces) == complete
    if subjects:
        assert len({face.subject for face in dataset.faces}) == subjects


def test_a_converted_point_is_known_and_seen_where_all_its_sources_are():
    landmarks = np.random.default_rng(0).uniform(0, 100, (68, 2))
    landmarks[36] = np.nan  # the left eye's outer corner, which its centre is made of too
    present = np.isfinite(landmarks).all(1)
    visible = present.copy()
    visible[54] = False  # a corner of the mouth
    face = FaceRecord(Path("a.jpg"), landmarks, present, visible, np.ones(4), np.zeros(3), "anna", "a")
    dataset = Dataset("pts:folder", IBUG68, (face,), ("one is unreadable",))

    converted = convert_dataset(dataset, AFLW21)
    assert (converted.spec, converted.scheme, converted.problems) == (dataset.spec, AFLW21, dataset.problems)
    (made,) = converted.faces
    for field in fields(FaceRecord):
        if field.name not in ("landmarks", "present", "visible"):
            assert getattr(made, field.name) is getattr(face, field.name)
    np.testing.assert_array_equal(made.present, np.isfinite(made.landmarks).all(1))
    assert np.flatnonzero(~made.present).tolist() == [6, 7]
    assert np.flatnonzero(~made.visible).tolist() == [6, 7, 19]
    np.testing.assert_array_equal(made.landmarks[19], landmarks[54])


def test_labels_that_cannot_be_converted_name_their_dataset():
    with pytest.raises(InputError, match="aflw:folder: cannot convert landmarks from aflw21 to lfpw29; known"):
        convert_dataset(Dataset("aflw:folder", AFLW21, ()), LFPW29)


@pytest.mark.parametrize("other", ["{}", "{}/", "{}/../{}", "link"])
def test_a_dataset_under_two_spellings_is_one(other, tmp_path, monkeypatch):
    (tmp_path / "faces").mkdir()
    (tmp_path / "link").symlink_to("faces")
    monkeypatch.chdir(tmp_path)
    specs = ["pts:faces", "pts:" + other.format("faces", "faces")]
    for names in (specs, specs[:1] * 2):
        with pytest.raises(InputError, match=f"each dataset once; got pts:faces and {names[1]}, which are the same"):
            read_datasets(names)


@pytest.mark.parametrize(
    ("tested", "pictures", "copies"),
    [
        (["t/1.jpg"], ["a/1.jpg", "a/2.jpg"], {"a/1.jpg": "t/1.jpg"}),
        (["a/1.jpg"], ["a/1.jpg", "b/1.jpg"], {"a/1.jpg": "a/1.jpg"}),  # a picture is no copy of one beside it
        (["t/b/1.jpg"], ["a/1.jpg", "b/1.jpg"], {"b/1.jpg": "t/b/1.jpg"}),
        (
            ["t/a/1.jpg", "t/b/1.jpg"],
            ["x/a/1.jpg", "x/b/1.jpg", "x/c/1.jpg"],
            {"x/a/1.jpg": "t/a/1.jpg", "x/b/1.jpg": "t/b/1.jpg"},
        ),
        (["t/1.jpg"], ["a/1.jpg", "b/1.jpg"], "t/1.jpg is tested, and may be .*a/1.jpg or .*b/1.jpg"),
        (["t/1.jpg"], [], {}),
    ],
)
def test_pictures_of_a_test_are_known_by_their_paths_or_names(
    tested: list[str], pictures: list[str], copies: dict[str, str] | str
) -> None:
    if isinstance(copies, str):
        with pytest.raises(InputError, match=copies):
            copies_of(map(Path, tested), map(Path, pictures))
    else:
        found = copies_of(map(Path, tested), map(Path, pictures))
        assert {str(picture): str(of) for picture, of in found.items()} == copies
