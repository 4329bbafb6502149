"""Formats of results: each says the same of the faces, and is what its readers expect."""

import csv
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jaxfit.data.fitted import Chunks, FittedFace, Problem

from jaxfit.data.pts import read_pts
from jaxfit.data.writers import DEFAULT_FORMATS, WRITERS, Results
from jaxfit.schemes.known import IBUG68

RNG = np.random.default_rng(0)


def numbers(*shape: int) -> tuple[float, ...]:
    return tuple(np.round(RNG.uniform(-20, 200, shape).ravel(), 3).tolist())


def face(picture: str, name: str, **more) -> FittedFace:
    return FittedFace(picture, name, (320, 200), "haar-frontal", numbers(4), numbers(68, 2), **more)


PLAIN = [face("a/ä, b.jpg", "ä, b_1"), face("a/ä, b.jpg", "ä, b_2"), face("c.jpg", "c_1")]
SURE = [
    face(
        f"{n}.jpg", f"{n}_1", confidence=0.25 * n, pose=numbers(3), scale=1.5, landmarks_3d=numbers(68, 3), b=numbers(4)
    )
    for n in range(3)
]


def results(faces: list[FittedFace]) -> Results:
    in_3d = faces[0].b is not None
    return Results(lambda: iter(faces), IBUG68, 4 if in_3d else None, faces[0].confidence is not None)


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("faces", [PLAIN, SURE], ids=["2d", "3d"])
def test_tables_have_a_row_a_face(faces: list[FittedFace], tmp_path: Path) -> None:
    in_3d = faces is SURE
    assert WRITERS["csv"](tmp_path, results(faces)) == ["landmarks.csv", *(["heads.csv"] if in_3d else [])]
    rows = read_csv(tmp_path / "landmarks.csv")
    for row, wanted in zip(rows, faces, strict=True):
        assert (row["image"], row["face"], row["box"]) == (wanted.image, wanted.face, wanted.kind)
        assert tuple(float(row[name]) for name in ("x", "y", "width", "height")) == wanted.box
        assert tuple(float(row[f"{axis}{n}"]) for n in range(1, 69) for axis in "xy") == wanted.landmarks
        assert (float(row["confidence"]) == wanted.confidence) if in_3d else "confidence" not in row
    for row, wanted in zip(read_csv(tmp_path / "heads.csv") if in_3d else [], faces, strict=in_3d):
        assert tuple(float(row[name]) for name in ("roll", "pitch", "yaw")) == wanted.pose
        assert float(row["scale"]) == wanted.scale
        assert tuple(float(row[f"b{n}"]) for n in range(1, 5)) == wanted.b
        assert tuple(float(row[f"{axis}{n}"]) for n in range(1, 69) for axis in "xyz") == wanted.landmarks_3d


@pytest.mark.parametrize("faces", [PLAIN, SURE], ids=["2d", "3d"])
def test_parquet_says_what_csv_says(faces: list[FittedFace], tmp_path: Path, monkeypatch) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr("jaxfit.data.writers.parquet._ROWS", 2)  # in several batches
    names = WRITERS["csv"](tmp_path, results(faces))
    assert WRITERS["parquet"](tmp_path, results(faces)) == [name.replace(".csv", ".parquet") for name in names]
    for name in names:
        wanted = read_csv(tmp_path / name)
        got = parquet.read_table(tmp_path / name.replace(".csv", ".parquet")).to_pylist()
        assert [list(row) for row in got] == [list(row) for row in wanted]
        for row, texts in zip(got, wanted, strict=True):
            for key, value in row.items():
                assert (
                    value == texts[key] if isinstance(value, str) else value == pytest.approx(float(texts[key]), 1e-5)
                )


def test_json_lines_have_an_object_a_face(tmp_path: Path) -> None:
    assert WRITERS["jsonl"](tmp_path, results(SURE)) == ["faces.jsonl"]
    lines = (tmp_path / "faces.jsonl").read_text(encoding="utf-8").splitlines()
    for line, wanted in zip(lines, SURE, strict=True):
        told = json.loads(line)
        assert np.ravel(told["landmarks"]).tolist() == list(wanted.landmarks)
        assert np.shape(told["landmarks_3d"]) == (68, 3)
        assert list(told["pose"].values()) == list(wanted.pose)
        assert told["confidence"] == wanted.confidence
        assert told["size"] == {"width": 320, "height": 200}
        assert told["box"]["kind"] == "haar-frontal"
    WRITERS["jsonl"](tmp_path, results(PLAIN))
    first = json.loads((tmp_path / "faces.jsonl").read_text(encoding="utf-8").splitlines()[0])
    assert first["image"] == "a/ä, b.jpg"
    assert {"confidence", "pose", "b"}.isdisjoint(first)


def test_coco_keypoints_are_as_coco_says(tmp_path: Path) -> None:
    assert WRITERS["coco"](tmp_path, results(PLAIN)) == ["keypoints.json"]
    told = json.loads((tmp_path / "keypoints.json").read_text(encoding="utf-8"))
    assert [(image["id"], image["file_name"]) for image in told["images"]] == [(1, "a/ä, b.jpg"), (2, "c.jpg")]
    assert all((image["width"], image["height"]) == (320, 200) for image in told["images"])
    (category,) = told["categories"]
    assert len(category["keypoints"]) == len(set(category["keypoints"])) == 68
    assert {index for bone in category["skeleton"] for index in bone} == set(range(1, 69))
    assert [(each["id"], each["image_id"]) for each in told["annotations"]] == [(1, 1), (2, 1), (3, 2)]
    for annotation, wanted in zip(told["annotations"], PLAIN, strict=True):
        points = np.reshape(annotation["keypoints"], (68, 3))
        np.testing.assert_array_equal(points[:, :2].ravel(), wanted.landmarks)
        assert (points[:, 2] == 2).all()
        assert (annotation["num_keypoints"], annotation["category_id"], annotation["iscrowd"]) == (68, 1, 0)
        low, high = points[:, :2].min(0), points[:, :2].max(0)
        np.testing.assert_allclose(annotation["bbox"], [*(low + 0.5), *(high - low)], atol=1e-3)
        assert annotation["area"] == pytest.approx(np.prod(high - low), abs=1)


def test_pts_files_are_read_back(tmp_path: Path) -> None:
    assert WRITERS["pts"](tmp_path, results(PLAIN)) == ["pts"]
    for wanted in PLAIN:
        found = read_pts(tmp_path / "pts" / f"{wanted.face}.pts")
        np.testing.assert_allclose(found.ravel(), wanted.landmarks, atol=1e-3)


@pytest.mark.parametrize("name", WRITERS)
def test_names_of_files_may_be_no_text(name: str, tmp_path: Path) -> None:
    if name == "parquet":
        pytest.importorskip("pyarrow")
    odd = os.fsdecode(b"\xe9t\xe9")
    assert WRITERS[name](tmp_path, results([replace(PLAIN[0], image=f"{odd}.jpg", face=odd)]))
    if name == "csv":
        assert b"\xe9t\xe9.jpg" in (tmp_path / "landmarks.csv").read_bytes()


@pytest.mark.parametrize("name", WRITERS)
def test_no_face_is_no_error(name: str, tmp_path: Path) -> None:
    if name == "parquet":
        pytest.importorskip("pyarrow")
    assert WRITERS[name](tmp_path, Results(lambda: iter(()), IBUG68, None, False))
    if name == "coco":
        told = json.loads((tmp_path / "keypoints.json").read_text(encoding="utf-8"))
        assert told["images"] == told["annotations"] == []


def test_default_formats_need_nothing_else() -> None:
    assert {*DEFAULT_FORMATS} <= {*WRITERS} - {"parquet"}


def test_chunks_give_back_what_they_got(tmp_path: Path) -> None:
    chunks = Chunks(tmp_path)
    problems = [Problem("x.jpg", "no face found: ü\nat all")]
    (tmp_path / ".0a.tmp.jsonl").write_text('{"image": "half a fa')
    chunks.put(1, SURE, [])
    assert not chunks.has(0)
    chunks.put(0, PLAIN, problems)
    assert chunks.has(0)
    assert chunks.has(1)
    assert list(chunks.faces()) == [*PLAIN, *SURE]
    assert list(chunks.problems()) == problems
