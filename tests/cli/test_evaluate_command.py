"""``jaxfit evaluate``: what it measures and writes, and what it prints."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from csv_files import labelled_box, read_csv, write_boxes
from drawn_heads import unlabelled

import jaxfit
from jaxfit.cli.main import main
from jaxfit.data.boxes import bounding_square
from jaxfit.evaluation.pose import pose_report
from jaxfit.labels.datasets import FORMATS
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.models.model import Model
from jaxfit.schemes.known import AFLW21, NO_LANDMARKS

BOX = ("x", "y", "width", "height")
POSED = ("roll", "pitch", "yaw", "true_roll", "true_pitch", "true_yaw")


def test_evaluate_reports_every_face(
    drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["evaluate", str(drawn_model), "--data", f"pts:{drawn}", "--out", str(tmp_path)]) == 0
    )  # of a scheme without eyes: relative to the bounding square
    spec = f"pts:{drawn}"
    report = json.loads((tmp_path / "report.json").read_text())["datasets"][spec]
    faces = read_csv(tmp_path / "faces.csv")
    errors = np.array([float(row["nmed"]) for row in faces])
    assert report["faces"] == len(faces) == 24
    assert report["normaliser"] == "bounding square"
    assert report["nmed"]["mean"] == pytest.approx(errors.mean(), abs=1e-5)
    assert report["nmed"]["median"] == pytest.approx(np.median(errors), abs=1e-5)
    assert report["nmed"]["ci95"] > 0
    assert report["auc_0.08"] == pytest.approx(np.mean(np.clip(1 - errors / 0.08, 0, None)), abs=1e-4)
    assert report["failure_0.08"] == pytest.approx(np.mean(errors > 0.08))
    assert report["seconds_per_face"] > 0
    assert np.median(errors) < 0.05
    assert f"{report['nmed']['median']:.4f}" in capsys.readouterr().out


def test_evaluate_counts_undetected_and_unreadable_faces_as_failures(
    drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    for source in drawn.glob("face00[0-3].*"):
        (folder / source.name).write_bytes(source.read_bytes())
    broken = folder / "face001.png"
    broken.write_bytes(broken.read_bytes()[:200])
    boxes = write_boxes(
        tmp_path / "boxes.csv",
        {"face000.png": (35, 35, 50, 50), "face001.png": (35, 35, 50, 50), "face002.png": (500, 500, 50, 50)},
    )
    command = ["evaluate", str(drawn_model), "--data", f"pts:{folder}", "--boxes", str(boxes), "--normaliser", "box"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())["datasets"][f"pts:{folder}"]
    assert (report["faces"], report["fitted"], report["undetected"]) == (4, 1, 3)
    assert report["failure_0.08"] >= 0.75
    problems = {row["face"]: row["problem"] for row in read_csv(tmp_path / "out" / "faces.csv")}
    assert "truncated" in problems["face001"]
    assert "outside" in problems["face002"]
    assert "no face box" in problems["face003"]
    assert "3 problems" in capsys.readouterr().err


def _as_it_is(dataset: Dataset, path: Path) -> Dataset:
    return dataset


@pytest.fixture
def formats(heads: tuple[FaceRecord, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawn heads as the datasets ``drawn:x``, with landmarks, and ``posed:x``, with boxes and poses alone."""
    for name, scheme, faces in (
        ("drawn", AFLW21, heads[:5]),
        ("posed", NO_LANDMARKS, tuple(map(unlabelled, heads[:5]))),
    ):
        dataset = Dataset(name, scheme, faces)
        monkeypatch.setitem(FORMATS, name, partial(_as_it_is, dataset))


@pytest.fixture
def head_file(head_models: dict[str, Model], tmp_path: Path) -> Path:
    """A file of 3D regression."""
    jaxfit.save(head_models["regression3d"], tmp_path / "heads.safetensors")
    return tmp_path / "heads.safetensors"


def strictly(text: str) -> Any:
    """What valid JSON says, which has neither NaN nor infinity."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_evaluate_reports_poses_and_errors_in_3d(
    formats: None, heads: tuple[FaceRecord, ...], head_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["evaluate", str(head_file), "--data", "drawn:x", "posed:x", "--out", str(out)]) == 0
    reports = strictly((out / "report.json").read_text())["datasets"]
    rows = read_csv(out / "faces.csv")
    assert tuple(rows[0]) == (
        "dataset",
        "face",
        "subject",
        "image",
        *BOX,
        "nmed",
        "nmed_3d",
        *POSED,
        "pose_order",
        "learned",
        "problem",
    )
    assert {row["pose_order"] for row in rows} == {"roll-pitch-yaw"}
    for spec, report in reports.items():
        assert report["pose_order"] == ["roll-pitch-yaw"]
        faces = [row for row in rows if row["dataset"] == spec]
        fitted, truth = (
            np.array([[float(row[name]) for name in names] for row in faces]) for names in (POSED[:3], POSED[3:])
        )
        np.testing.assert_allclose(truth, np.array([face.pose for face in heads[:5]]), atol=1e-3)
        for within, limit in (("all", 360), ("yaw_within_45", 45)):
            chosen = np.abs(truth[:, 2]) <= limit
            expected: Any = pose_report(fitted[chosen], truth[chosen])["all"]
            errors = report["pose"][within]
            assert (errors["faces"], errors["undetected"]) == (chosen.sum(), 0)
            for angle in POSED[:3]:
                assert set(errors[angle]) == {"mae", "ci95", "median", "bias", "spearman"}
                for name, value in errors[angle].items():
                    assert value == pytest.approx(expected[angle][name], abs=2e-3), (spec, within, angle, name)
    flat, solid = ([float(row[name]) for row in rows[:5]] for name in ("nmed", "nmed_3d"))
    assert reports["drawn:x"]["nmed_3d"]["median"] == pytest.approx(np.median(solid), abs=1e-5)
    assert reports["drawn:x"]["nmed"]["median"] == pytest.approx(np.median(flat), abs=1e-5)
    assert {row[name] for row in rows[5:] for name in ("nmed", "nmed_3d")} == {"nan"}
    assert reports["posed:x"]["nmed_3d"]["median"] is reports["posed:x"]["nmed"]["mean"] is None
    np.testing.assert_allclose(
        np.array([[float(row[name]) for name in BOX] for row in rows[5:]]),
        [bounding_square(face.landmarks) for face in heads[:5]],
        atol=1e-3,
    )
    said = capsys.readouterr().out
    assert "the model does not know how faces lie in posed boxes and takes them for square ones" in said
    assert said.count("errors of the pose in degrees") == 2
    assert f"{reports['drawn:x']['pose']['all']['yaw']['mae']:.2f}" in said
    assert f"{reports['drawn:x']['nmed_3d']['median']:.4f}" in said


def test_boxes_of_ones_own_take_the_place_of_the_datasets(
    formats: None,
    heads: tuple[FaceRecord, ...],
    head_models: dict[str, Model],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    model = head_models["regression3d"]
    square = model.placements["square"]
    known = replace(model, placements={"square": square, "posed": replace(square, log_scale=square.log_scale + 0.1)})
    jaxfit.save(known, tmp_path / "known.safetensors")
    evaluate = ["evaluate", str(tmp_path / "known.safetensors"), "--data", "posed:x", "--out"]
    boxes = write_boxes(
        tmp_path / "boxes.csv", {face.image.name: bounding_square(face.landmarks) for face in heads[:5]}
    )
    assert main([*evaluate, str(tmp_path / "a")]) == 0
    assert main([*evaluate, str(tmp_path / "b"), "--boxes", str(boxes), "--box-kind", "posed"]) == 0
    assert main([*evaluate, str(tmp_path / "c"), "--boxes", str(boxes)]) == 0
    assert "does not know" not in capsys.readouterr().out
    own, given, squares = ((tmp_path / name / "faces.csv").read_text() for name in "abc")
    assert own == given != squares


def test_boxes_of_pictures_of_one_name(
    drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, face in (("a", "face000"), ("b", "face001")):
        (tmp_path / name).mkdir()
        for suffix in (".png", ".pts"):
            (tmp_path / name / f"001{suffix}").write_bytes((drawn / f"{face}{suffix}").read_bytes())
    boxes = {f"{name}/001.png": labelled_box(tmp_path / name / "001.png") for name in "ab"}
    table = write_boxes(tmp_path / "boxes.csv", {**boxes, "c/001.png": (1, 2, 3, 4)})
    evaluate = ["evaluate", str(drawn_model), "--normaliser", "box", "--out", str(tmp_path / "out"), "--data"]
    evaluate += [f"pts:{tmp_path / 'a'}", f"pts:{tmp_path / 'b'}", "--boxes"]
    assert main([*evaluate, str(table)]) == 0
    found = [
        [float(row[side]) for side in ("x", "y", "width", "height")] for row in read_csv(tmp_path / "out" / "faces.csv")
    ]
    np.testing.assert_allclose(found, list(boxes.values()), atol=1e-3)
    assert "rows for pictures that were not given: 1, such as c/001.png" in capsys.readouterr().err
    assert main([*evaluate, str(write_boxes(table, {"001.png": (1, 2, 3, 4)}))]) == 2
    assert f"may mean {tmp_path}/a/001.png or {tmp_path}/b/001.png" in capsys.readouterr().err


def test_reports_of_2d_models_have_no_poses(
    formats: None, drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, spec = tmp_path / "out", f"pts:{drawn}"
    assert (
        main(["evaluate", str(drawn_model), "--data", spec, "posed:x", "--normaliser", "box", "--out", str(out)]) == 0
    )
    for report in strictly((out / "report.json").read_text())["datasets"].values():
        assert not {"pose", "nmed_3d"} & set(report)
    rows = read_csv(out / "faces.csv")
    assert {row[name] for row in rows for name in ("nmed_3d", *POSED[:3])} == {""}
    assert {row["true_yaw"] for row in rows if row["dataset"] == spec} == {""}
    assert "" not in {row["true_yaw"] for row in rows if row["dataset"] == "posed:x"}
    said = capsys.readouterr().out
    assert "3D" not in said
    assert "errors of the pose" not in said


def test_only_3d_alignments_are_refined(
    drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluate = ["evaluate", str(drawn_model), "--data", f"pts:{drawn}", "--normaliser", "box", "--refine"]
    assert main([*evaluate, "--out", str(tmp_path / "out")]) == 2
    assert "only models of the method alignment3d" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("search", [["--smallest", "30"], ["--score", "0.5"], ["--any-rotation"]])
def test_a_search_needs_a_detector(
    search: list[str], drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    request = ["evaluate", str(drawn_model), "--data", f"pts:{drawn}", "--out", str(tmp_path / "out")]
    assert main([*request, *search]) == 2
    assert "expected a detector with smallest, score or any rotation" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
