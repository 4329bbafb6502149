"""Digests of the pictures that a model learned from: kept in its file and by all that derives from it."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import jaxfit
from jaxfit.data.pictures import read_grey, write_image
from jaxfit.errors import ModelError
from jaxfit.evaluation import Evaluation, start_boxes
from jaxfit.evaluation.tables import SUMMARY_COLUMNS, summary_row, text_table
from jaxfit.models.digests import DigestingReader, digest_set, picture_digest, same_pictures, union
from jaxfit.models.files import write_tensors


def test_digests_are_those_of_pixels(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 255, (12, 9), np.uint8)
    changed = grey.copy()
    changed[3, 4] ^= 1
    others = (grey.T, grey[:, ::-1], grey.reshape(9, 12), changed, grey[1:])
    assert len({picture_digest(each) for each in (grey, *others)}) == 6
    assert picture_digest(np.asfortranarray(grey)) == picture_digest(grey)
    write_image(tmp_path / "a.png", grey)
    write_image(tmp_path / "b.bmp", grey)
    (tmp_path / "damaged.png").write_bytes(b"no picture")
    reader = DigestingReader(read_grey)
    digests = digest_set([picture_digest(grey), 0, 2**64 - 1, 0])
    assert len(digests) == 3
    found = reader.among(
        [tmp_path / name for name in ("a.png", "b.bmp", "damaged.png", "missing.png")], digests
    ).tolist()
    assert found == [True, True, False, False]


def test_renamed_copies_are_known_by_their_pixels(tmp_path: Path) -> None:
    tall = np.random.default_rng(1).integers(0, 255, (12, 9, 3), np.uint8)
    pictures = {"a.png": tall, "copy.bmp": tall, "other.png": 255 - tall, "turned.png": tall.swapaxes(0, 1)}
    for name, picture in pictures.items():
        write_image(tmp_path / name, picture)
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "damaged.png").write_bytes((tmp_path / "a.png").read_bytes()[:-20])
    tested = [tmp_path / name for name in ("missing.png", "empty.png", "a.png")]
    others = [tmp_path / name for name in (*pictures, "gone.png", "damaged.png") if name != "a.png"]
    assert same_pictures(tested, others) == {tmp_path / "copy.bmp": tmp_path / "a.png"}


def test_what_is_unknown_stays_unknown() -> None:
    one, other = digest_set([3, 1]), digest_set([3, 2**63])
    np.testing.assert_array_equal(union(one, other), np.array([1, 3, 2**63], np.uint64))
    assert union(one, None) is None
    assert union() is None


def evaluation(model: jaxfit.Model, folder: Path) -> Evaluation:
    faces = jaxfit.read_dataset(f"pts:{folder}").faces
    boxes = start_boxes(faces)
    boxes[0] = np.nan  # a face that no detector found was learned from all the same
    return jaxfit.evaluate(model, faces, boxes, normaliser="box")


def test_evaluations_say_what_was_learned_from(drawn: Path, drawn_model: Path, tmp_path: Path) -> None:
    model = jaxfit.load(drawn_model)
    assert model.learned is not None
    assert (model.learned.dtype, len(model.learned)) == (np.uint64, 24)
    for number in range(3):  # renamed copies, and then a picture that nobody has seen
        for suffix in ("png", "pts"):
            shutil.copy(drawn / f"face00{number}.{suffix}", tmp_path / f"other{number}.{suffix}")
    write_image(tmp_path / "other2.png", 255 - jaxfit.read_image(tmp_path / "other2.png"))
    found = evaluation(model, tmp_path)
    assert found.learned is not None
    assert found.learned.tolist() == [True, True, False]
    assert Evaluation.join([found, found]).learned.sum() == 4  # type: ignore[union-attr]
    row = summary_row(found.errors, learned=found.learned)
    assert row["learned from"] == 2
    without = evaluation(replace(model, learned=None), tmp_path)
    assert without.learned is None
    np.testing.assert_array_equal(without.errors, found.errors)
    table = text_table([row, summary_row(without.errors)], SUMMARY_COLUMNS)
    assert "unknown" in table.splitlines()[3]


def test_files_keep_them_and_do_without(drawn_model: Path, tmp_path: Path) -> None:
    model = jaxfit.load(drawn_model)
    for learned in (model.learned, None, np.empty(0, np.uint64)):
        jaxfit.save(replace(model, learned=learned), tmp_path / "m.safetensors")
        again = jaxfit.load(tmp_path / "m.safetensors").learned
        assert (again is None) == (learned is None)
        np.testing.assert_array_equal(again, learned)


@pytest.mark.parametrize(
    "learned", [np.zeros((2, 2), np.uint64), np.zeros(3, np.float32), np.array([4, 4], np.uint64)], ids=str
)
def test_damaged_ones_are_refused(
    learned: np.ndarray, drawn_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = jaxfit.load(drawn_model)
    path = tmp_path / "m.safetensors"
    jaxfit.save(model, path)

    def with_learned(path: Path, tensors: dict, key: str, header: dict) -> None:
        write_tensors(path, tensors | {"learned": learned}, key, header)

    monkeypatch.setattr("jaxfit.models.files.write_tensors", with_learned)
    jaxfit.save(model, path)
    with pytest.raises(ModelError, match="damaged: learned has"):
        jaxfit.load(path)
