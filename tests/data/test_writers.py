"""Formats of results: each says the same of the faces, and is what its readers expect."""

import csv
import json
import os
from pathlib import Path

import numpy as np
import pytest
from face_rows import PLAIN, SURE, rows_of

from jaxfit.data.pts import read_pts
from jaxfit.data.rows import Row
from jaxfit.data.writers import DEFAULT_FORMATS, WRITERS

every_kind = pytest.mark.parametrize("faces", [PLAIN, SURE], ids=["2d", "3d"])


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@every_kind
def test_tables_have_a_row_a_face(faces: list[Row], tmp_path: Path) -> None:
    in_3d = faces is SURE
    assert WRITERS["csv"](tmp_path, rows_of(faces)) == ["landmarks.csv", *(["heads.csv"] if in_3d else [])]
    rows = read_csv(tmp_path / "landmarks.csv")
    for row, wanted in zip(rows, faces, strict=True):
        assert (row["image"], row["face"], row["box"]) == (wanted["image"], wanted["face"], wanted["box"]["kind"])
        assert all(float(row[name]) == wanted["box"][name] for name in ("x", "y", "width", "height"))
        assert [[float(row[f"{axis}{n}"]) for axis in "xy"] for n in range(1, 69)] == wanted["landmarks"]
        assert (float(row["confidence"]) == wanted["confidence"]) if in_3d else "confidence" not in row
    for row, wanted in zip(read_csv(tmp_path / "heads.csv") if in_3d else [], faces, strict=in_3d):
        assert all(float(row[name]) == wanted["pose"][name] for name in ("roll", "pitch", "yaw"))
        assert float(row["scale"]) == wanted["scale"]
        assert [float(row[f"b{n}"]) for n in range(1, 5)] == wanted["b"]
        assert [[float(row[f"{axis}{n}"]) for axis in "xyz"] for n in range(1, 69)] == wanted["landmarks_3d"]


@every_kind
def test_parquet_says_what_csv_says(faces: list[Row], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr("jaxfit.data.writers.parquet._ROWS", 2)  # in several batches
    names = WRITERS["csv"](tmp_path, rows_of(faces))
    assert WRITERS["parquet"](tmp_path, rows_of(faces)) == [name.replace(".csv", ".parquet") for name in names]
    for name in names:
        wanted = read_csv(tmp_path / name)
        found = parquet.read_table(tmp_path / name.replace(".csv", ".parquet")).to_pylist()
        assert [list(row) for row in found] == [list(row) for row in wanted]
        for row, texts in zip(found, wanted, strict=True):
            for key, value in row.items():
                assert (
                    value == texts[key] if isinstance(value, str) else value == pytest.approx(float(texts[key]), 1e-5)
                )


@every_kind
def test_json_lines_are_the_rows(faces: list[Row], tmp_path: Path) -> None:
    assert WRITERS["jsonl"](tmp_path, rows_of(faces)) == ["faces.jsonl"]
    text = (tmp_path / "faces.jsonl").read_text(encoding="utf-8")
    assert [json.loads(line) for line in text.splitlines()] == faces
    assert faces is SURE or "a/ä, b.jpg" in text


def test_coco_keypoints_are_as_coco_says(tmp_path: Path) -> None:
    assert WRITERS["coco"](tmp_path, rows_of(PLAIN)) == ["keypoints.json"]
    content = json.loads((tmp_path / "keypoints.json").read_text(encoding="utf-8"))
    assert [(image["id"], image["file_name"]) for image in content["images"]] == [(1, "a/ä, b.jpg"), (2, "c.jpg")]
    assert all((image["width"], image["height"]) == (320, 200) for image in content["images"])
    (category,) = content["categories"]
    assert len(category["keypoints"]) == len(set(category["keypoints"])) == 68
    assert {index for bone in category["skeleton"] for index in bone} == set(range(1, 69))
    assert [(each["id"], each["image_id"]) for each in content["annotations"]] == [(1, 1), (2, 1), (3, 2)]
    for annotation, wanted in zip(content["annotations"], PLAIN, strict=True):
        points = np.reshape(annotation["keypoints"], (68, 3))
        np.testing.assert_array_equal(points[:, :2], wanted["landmarks"])
        assert (points[:, 2] == 2).all()
        assert (annotation["num_keypoints"], annotation["category_id"], annotation["iscrowd"]) == (68, 1, 0)
        low, high = points[:, :2].min(0), points[:, :2].max(0)
        np.testing.assert_allclose(annotation["bbox"], [*(low + 0.5), *(high - low)], atol=1e-3)
        assert annotation["area"] == pytest.approx(np.prod(high - low), abs=1)


@pytest.mark.parametrize(("faces", "scores"), [(PLAIN, [1, 1, 1]), (SURE, [0, 0.25, 0.5])], ids=["2d", "3d"])
def test_scores_of_coco_are_confidences(faces: list[Row], scores: list[float], tmp_path: Path) -> None:
    WRITERS["coco"](tmp_path, rows_of(faces))
    content = json.loads((tmp_path / "keypoints.json").read_text(encoding="utf-8"))
    assert [annotation["score"] for annotation in content["annotations"]] == scores


def test_pts_files_are_read_back(tmp_path: Path) -> None:
    assert WRITERS["pts"](tmp_path, rows_of(PLAIN)) == ["pts"]
    for wanted in PLAIN:
        found = read_pts(tmp_path / "pts" / f"{wanted['face']}.pts")
        np.testing.assert_allclose(found, wanted["landmarks"], atol=1e-3)


@pytest.mark.parametrize("name", WRITERS)
def test_names_of_files_may_be_no_text(name: str, tmp_path: Path) -> None:
    if name == "parquet":
        pytest.importorskip("pyarrow")
    odd = os.fsdecode(b"\xe9t\xe9")
    (file,) = WRITERS[name](tmp_path, rows_of([PLAIN[0] | {"image": f"={odd}.jpg", "face": odd}]))
    if (tmp_path / file).is_file() and name != "parquet":
        text = (tmp_path / file).read_text(encoding="utf-8")
        # Programs that label look for pictures from the file's folder. JSON doubles backslashes once more.
        start = os.path.relpath(".", tmp_path) if name in ("tps", "imglab") else "."
        assert rf"{start}/=\xe9t\xe9.jpg" in text.replace(r"\\", "\\")


@pytest.mark.parametrize("blocked", [True, False])
def test_what_cannot_be_written_belongs_to_its_picture(blocked: bool, tmp_path: Path) -> None:
    rows = rows_of(PLAIN)
    if blocked:
        (tmp_path / "pts" / f"{PLAIN[0]['face']}.pts").mkdir(parents=True)
    assert WRITERS["pts"](tmp_path, rows) == ["pts"]
    assert [image for image, why in rows.failures if "cannot write" in why] == [PLAIN[0]["image"]] * blocked
    assert (tmp_path / "pts" / f"{PLAIN[-1]['face']}.pts").is_file()


@pytest.mark.parametrize("name", WRITERS)
def test_no_face_is_no_error(name: str, tmp_path: Path) -> None:
    if name == "parquet":
        pytest.importorskip("pyarrow")
    assert WRITERS[name](tmp_path, rows_of([]))
    if name == "coco":
        content = json.loads((tmp_path / "keypoints.json").read_text(encoding="utf-8"))
        assert content["images"] == content["annotations"] == []


def test_default_formats_need_nothing_else() -> None:
    assert {*DEFAULT_FORMATS} <= {*WRITERS} - {"parquet"}
