"""Faces of several datasets, gathered to learn from."""

from functools import partial
from pathlib import Path

import pytest

from jaxfit.labels import gather_faces
from jaxfit.labels.datasets import FORMATS
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.schemes import AFLW21


def _as_it_is(dataset: Dataset, path: Path) -> Dataset:
    return dataset


@pytest.fixture(autouse=True)
def _datasets(heads: tuple[FaceRecord, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawn heads as the datasets ``first`` and ``second``, which share none, and ``tested``, one picture of each."""
    for name, faces in {"first": heads[:4], "second": heads[4:6], "tested": heads[3:5]}.items():
        dataset = Dataset(name, AFLW21, faces, (f"one of {name} was torn",))
        monkeypatch.setitem(FORMATS, name, partial(_as_it_is, dataset))


def test_people_of_two_datasets_are_not_one_and_all_problems_are_kept(heads: tuple[FaceRecord, ...]) -> None:
    found = gather_faces(["first:a", "second:b"])
    assert [face.image for face in found.faces] == [face.image for face in heads[:6]]
    assert [face.subject.partition("/")[0] for face in found.faces] == [*"000011"]
    assert (found.scheme, found.notes) == (AFLW21, ())
    assert found.problems == ("one of first was torn", "one of second was torn")


def test_pictures_that_are_tested_on_are_left_out_and_counted(heads: tuple[FaceRecord, ...]) -> None:
    found = gather_faces(["first:a", "second:b"], without=["tested:c"])
    assert [face.image for face in found.faces] == [face.image for face in (*heads[:3], heads[5])]
    assert found.notes == ("2 of 6 faces left out: tested:c has their pictures",)
