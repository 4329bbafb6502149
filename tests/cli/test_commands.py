"""The commands, as a user types them: what they write, what they print, and what they say of bad input."""

import csv
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from drawing import TRAIN
from drawn_heads import unlabelled

import jaxfit
from jaxfit.cli.labelled_faces import read_faces
from jaxfit.cli.main import main, parser
from jaxfit.data.boxes import bounding_square
from jaxfit.data.overlays import draw_head, draw_landmarks
from jaxfit.data.pictures import write_image
from jaxfit.data.pts import read_pts, write_pts
from jaxfit.evaluation.pose import pose_report
from jaxfit.heads.model import load_head_model, save_head_model
from jaxfit.labels.datasets import FORMATS
from jaxfit.labels.records import Dataset
from jaxfit.schemes.known import AFLW21, NO_LANDMARKS

BOX = ("x", "y", "width", "height")
POSED = ("roll", "pitch", "yaw", "true_roll", "true_pitch", "true_yaw")


def rows_of(path: Path) -> list[dict[str, str]]:
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write_boxes(path: Path, boxes: Mapping[str, Sequence[float] | np.ndarray]) -> Path:
    lines = [f"{name},{','.join(map(str, box))}" for name, box in boxes.items()]
    path.write_text("\n".join(["image,x,y,width,height", *lines]) + "\n")
    return path


def test_training_twice_with_one_seed_gives_the_same_file(drawn: Path, model: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.safetensors"
    assert main(["train", "--data", f"pts:{drawn}", "--out", str(again), *TRAIN]) == 0
    assert again.read_bytes() == model.read_bytes()
    other = tmp_path / "other.safetensors"
    assert main(["train", "--data", f"pts:{drawn}", "--out", str(other), *TRAIN, "--seed", "1"]) == 0
    assert other.read_bytes() != model.read_bytes()


def test_evaluate_reports_every_face(drawn: Path, model: Path, tmp_path: Path, capsys) -> None:
    assert main(["evaluate", str(model), "--data", f"pts:{drawn}", "--normaliser", "box", "--out", str(tmp_path)]) == 0
    spec = f"pts:{drawn}"
    report = json.loads((tmp_path / "report.json").read_text())["datasets"][spec]
    faces = rows_of(tmp_path / "faces.csv")
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
    drawn: Path, model: Path, tmp_path: Path, capsys
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    for source in list(sorted(drawn.glob("face00[0-3].*"))):
        (folder / source.name).write_bytes(source.read_bytes())
    broken = folder / "face001.png"
    broken.write_bytes(broken.read_bytes()[:200])
    boxes = write_boxes(
        tmp_path / "boxes.csv",
        {"face000.png": (35, 35, 50, 50), "face001.png": (35, 35, 50, 50), "face002.png": (500, 500, 50, 50)},
    )
    command = ["evaluate", str(model), "--data", f"pts:{folder}", "--boxes", str(boxes), "--normaliser", "box"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())["datasets"][f"pts:{folder}"]
    assert (report["faces"], report["fitted"], report["undetected"]) == (4, 1, 3)
    assert report["failure_0.08"] >= 0.75
    problems = {row["face"]: row["problem"] for row in rows_of(tmp_path / "out" / "faces.csv")}
    assert "truncated" in problems["face001"]
    assert "outside" in problems["face002"]
    assert "no face box" in problems["face003"]
    assert "3 problems" in capsys.readouterr().err


def test_fit_with_boxes_writes_csv_pts_and_overlays(drawn: Path, model: Path, tmp_path: Path) -> None:
    pictures = sorted(drawn.glob("*.png"))[:3]
    squares = {picture.name: bounding_square(read_pts(picture.with_suffix(".pts"))) for picture in pictures}
    boxes = write_boxes(tmp_path / "boxes.csv", squares)
    out = tmp_path / "out"
    assert main(["fit", *map(str, pictures), "--model", str(model), "--boxes", str(boxes), "--out", str(out)]) == 0
    rows = rows_of(out / "landmarks.csv")
    assert [Path(row["image"]).name for row in rows] == [picture.name for picture in pictures]
    for row in rows:
        listed = np.array([[float(row[f"x{i}"]), float(row[f"y{i}"])] for i in range(1, 6)])
        # .pts files count from 1, the table from 0.
        np.testing.assert_allclose(read_pts(out / "pts" / f"{row['face']}.pts"), listed, atol=2e-3)
        truth = read_pts(drawn / f"{Path(row['image']).stem}.pts")
        assert np.linalg.norm(listed - truth, axis=1).mean() < 2
    for picture in pictures:
        overlay = jaxfit.read_image(out / "overlays" / f"{picture.stem}.jpg")
        assert np.abs(overlay.astype(int) - jaxfit.read_image(picture)).max() > 60


def test_the_parametric_method_with_several_initialisations(drawn: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "model.safetensors"
    starts = ["--initialisations", "3", "--rotations", "-40", "40"]
    assert main(["train", "--data", f"pts:{drawn}", "--method", "parametric", *starts, "--out", str(out), *TRAIN]) == 0
    model = jaxfit.load(out)
    assert (model.training["method"], model.training["initialisations"]) == ("parametric", 3)
    assert model.cascade.descriptor.orientation == "face"
    assert model.cascade.space.size == len(model.cascade.space.model.deviations) + 5
    assert (
        main(["evaluate", str(out), "--data", f"pts:{drawn}", *starts, "--normaliser", "box", "--out", str(tmp_path)])
        == 0
    )
    assert np.median([float(row["nmed"]) for row in rows_of(tmp_path / "faces.csv")]) < 0.06
    picture = drawn / "face000.png"
    boxes = write_boxes(tmp_path / "boxes.csv", {picture.name: bounding_square(read_pts(picture.with_suffix(".pts")))})
    fit = ["fit", str(picture), "--model", str(out), "--boxes", str(boxes), "--out", str(tmp_path / "fits")]
    assert main([*fit, *starts]) == 0
    capsys.readouterr()
    assert main([*fit, "--initialisations", "0"]) == 2
    assert "expected one initialisation" in capsys.readouterr().err


def test_fit_reports_bad_pictures_and_goes_on(drawn: Path, model: Path, tmp_path: Path, capsys) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    good = (drawn / "face000.png").read_bytes()
    (folder / "good.png").write_bytes(good)
    (folder / "cut.png").write_bytes(good[:300])
    (folder / "text.jpg").write_text("not a picture")
    (folder / "empty.png").write_bytes(b"")
    (folder / "missing.png").write_bytes(good)
    write_image(folder / "outside.png", np.zeros((40, 40, 3), np.uint8))
    boxes = {name: (35, 35, 50, 50) for name in ("good.png", "cut.png", "text.jpg", "empty.png")}
    csv_file = write_boxes(tmp_path / "boxes.csv", {**boxes, "outside.png": (300, 300, 9, 9)})
    out = tmp_path / "out"
    assert main(["fit", str(folder), "--model", str(model), "--boxes", str(csv_file), "--out", str(out)]) == 0
    assert len(rows_of(out / "landmarks.csv")) == 1
    said = capsys.readouterr().err
    for words in ("5 problems", "cut.png", "text.jpg", "empty.png", "missing.png", "outside.png"):
        assert words in said


def test_fit_names_pictures_of_one_stem_apart(drawn: Path, model: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "same.png").write_bytes((drawn / "face000.png").read_bytes())
    boxes = write_boxes(tmp_path / "boxes.csv", {"same.png": (35, 35, 50, 50)})
    out = tmp_path / "out"
    folders = [str(tmp_path / "a"), str(tmp_path / "b")]
    assert main(["fit", *folders, "--model", str(model), "--boxes", str(boxes), "--out", str(out)]) == 0
    assert len(list((out / "pts").glob("*.pts"))) == len(list((out / "overlays").glob("*.jpg"))) == 2


def test_wrong_requests_stop_at_once_and_say_what_to_do(drawn: Path, model: Path, tmp_path: Path, capsys) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    bad_boxes = tmp_path / "bad.csv"
    bad_boxes.write_text("image,x,y\na.png,1,2\n")
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(model.read_bytes()[:1000])
    data, out = f"pts:{drawn}", str(tmp_path / "out")
    requests = {
        "FORMAT:PATH": ["evaluate", str(model), "--data", str(drawn), "--out", out],
        "no pictures in": ["fit", str(empty), "--model", str(model), "--out", out],
        "no such file": ["fit", str(tmp_path / "nowhere.jpg"), "--model", str(model), "--out", out],
        "expected the columns": ["evaluate", str(model), "--data", data, "--boxes", str(bad_boxes), "--out", out],
        "damaged": ["evaluate", str(damaged), "--data", data, "--out", out],
        "no model 'nothing'": ["evaluate", "nothing", "--data", data, "--out", out],
        "has no normaliser 'outer'": ["evaluate", str(model), "--data", data, "--out", out],
        "give that file too": ["fit", str(drawn), "--model", str(model), "--box-kind", "x", "--out", out],
        ".safetensors in a folder that can be written to": [
            "train",
            "--data",
            data,
            "--out",
            str(tmp_path / "model.npz"),
        ],
        "augmentations >= 1": ["train", "--data", data, "--out", f"{out}.safetensors", *TRAIN, "--augmentations", "0"],
        "pts": ["train", "--data", f"pts:{empty}", "--out", f"{out}.safetensors"],
        "cannot convert landmarks from points5 to aflw21": ["evaluate", str(model), "--data", data]
        + ["--scheme", "aflw21", "--out", out],
    }
    for words, request in requests.items():
        assert main(request) == 2, request
        said = capsys.readouterr().err
        assert "jaxfit: error:" in said, request
        assert words in said, request
    assert not (tmp_path / "out.safetensors").exists()


def test_a_reader_who_has_seen_enough_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "jaxfit", "models"]
    listing = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (listing.returncode, listing.stderr) == (141, "")


def test_datasets_of_different_landmarks_are_not_mixed(drawn: Path, model: Path, tmp_path: Path, capsys) -> None:
    for source in drawn.glob("face00[0-4].*"):
        (tmp_path / source.name).write_bytes(source.read_bytes())
    for path in tmp_path.glob("*.pts"):
        path.write_text("\n".join([*path.read_text().splitlines()[:-2], "}"]).replace("5\n{", "4\n{"))
    assert main(["evaluate", str(model), "--data", f"pts:{tmp_path}", "--out", str(tmp_path / "o")]) == 2
    assert "5 landmarks" in capsys.readouterr().err
    both = [f"pts:{drawn}", f"pts:{tmp_path}"]
    assert main(["train", "--data", *both, "--out", str(tmp_path / "m.safetensors")]) == 2
    assert "must share their landmarks" in capsys.readouterr().err


def test_labels_of_several_schemes_train_one_model_and_are_converted_to_evaluate_it(
    drawn: Path, tmp_path: Path, capsys
) -> None:
    picture = (drawn / "face000.png").read_bytes()
    rng = np.random.default_rng(0)
    specs = []
    for count in (29, 68):
        folder = tmp_path / f"labelled{count}"
        folder.mkdir()
        for number in range(3):
            (folder / f"face{number:03}.png").write_bytes(picture)
            write_pts(folder / f"face{number:03}.pts", rng.uniform(30, 90, (count, 2)))
        specs.append(f"pts:{folder}")
    out = tmp_path / "model.safetensors"
    train = ["train", "--data", *specs, "--out", str(out), *TRAIN, "--windows", "0.6", "--no-haar"]
    assert main(train) == 2
    assert "lfpw29, " in (said := capsys.readouterr().err)
    assert "--scheme can convert some" in said
    assert main([*train, "--scheme", "lfpw27"]) == 0
    assert "lfpw27, trained on 6 faces" in capsys.readouterr().out
    assert jaxfit.load(str(out)).scheme.name == "lfpw27"

    evaluate = ["evaluate", str(out), "--data", specs[1], "--out"]
    assert main([*evaluate, str(tmp_path / "a")]) == 0
    assert f"{specs[1]}: labels converted from ibug68 to the model's lfpw27" in capsys.readouterr().out
    assert main([*evaluate, str(tmp_path / "b"), "--scheme", "lfpw27"]) == 0
    assert "converted" not in capsys.readouterr().out
    assert (tmp_path / "a" / "faces.csv").read_bytes() == (tmp_path / "b" / "faces.csv").read_bytes()
    assert main([*evaluate, str(tmp_path / "c"), "--scheme", "aflw21"]) == 2
    assert "finds 27 landmarks (lfpw27)" in capsys.readouterr().err


@pytest.fixture
def formats(heads, monkeypatch) -> None:
    """Drawn heads as the datasets ``drawn:x``, with landmarks, and ``posed:x``, with boxes and poses alone."""
    for name, scheme, faces in (
        ("drawn", AFLW21, heads[:5]),
        ("posed", NO_LANDMARKS, tuple(map(unlabelled, heads[:5]))),
    ):
        dataset = Dataset(name, scheme, faces)
        monkeypatch.setitem(FORMATS, name, lambda _, dataset=dataset: dataset)


@pytest.fixture
def head_file(head_models, tmp_path: Path) -> Path:
    """A file of 3D regression."""
    jaxfit.save(head_models["regression3d"], tmp_path / "heads.safetensors")
    return tmp_path / "heads.safetensors"


def strictly(text: str) -> dict:
    """What valid JSON says: NaN and infinity are none."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_evaluate_reports_poses_and_errors_in_3d(formats, heads, head_file: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert main(["evaluate", str(head_file), "--data", "drawn:x", "posed:x", "--out", str(out)]) == 0
    reports = strictly((out / "report.json").read_text())["datasets"]
    rows = rows_of(out / "faces.csv")
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
        "problem",
    )
    assert {row["pose_order"] for row in rows} == {"roll-pitch-yaw"}
    for spec, report in reports.items():
        assert report["pose_order"] == ["roll-pitch-yaw"]
        faces = [row for row in rows if row["dataset"] == spec]
        fitted, truth = ([[float(row[name]) for name in names] for row in faces] for names in (POSED[:3], POSED[3:]))
        np.testing.assert_allclose(truth, [face.pose for face in heads[:5]], atol=1e-3)
        for within, limit in (("all", 360), ("yaw_within_45", 45)):
            chosen = np.abs(np.array(truth)[:, 2]) <= limit
            expected = pose_report(np.array(fitted)[chosen], np.array(truth)[chosen])["all"]
            told = report["pose"][within]
            assert (told["faces"], told["undetected"]) == (chosen.sum(), 0)
            for angle in POSED[:3]:
                assert set(told[angle]) == {"mae", "ci95", "median", "bias", "spearman"}
                for name, value in told[angle].items():
                    assert value == pytest.approx(expected[angle][name], abs=2e-3), (spec, within, angle, name)
    errors = [[float(row[name]) for row in rows[:5]] for name in ("nmed", "nmed_3d")]
    assert reports["drawn:x"]["nmed_3d"]["median"] == pytest.approx(np.median(errors[1]), abs=1e-5)
    assert reports["drawn:x"]["nmed"]["median"] == pytest.approx(np.median(errors[0]), abs=1e-5)
    assert {row[name] for row in rows[5:] for name in ("nmed", "nmed_3d")} == {"nan"}
    assert reports["posed:x"]["nmed_3d"]["median"] is reports["posed:x"]["nmed"]["mean"] is None
    np.testing.assert_allclose(
        [[float(row[name]) for name in BOX] for row in rows[5:]],
        [unlabelled(face).box for face in heads[:5]],
        atol=1e-3,
    )
    said = capsys.readouterr().out
    assert "the model does not know how faces lie in posed boxes and takes them for square ones" in said
    assert said.count("errors of the pose in degrees") == 2
    assert f"{reports['drawn:x']['pose']['all']['yaw']['mae']:.2f}" in said
    assert f"{reports['drawn:x']['nmed_3d']['median']:.4f}" in said


def test_boxes_of_ones_own_take_the_place_of_the_datasets(formats, heads, head_models, tmp_path: Path, capsys) -> None:
    model = head_models["regression3d"]
    square = model.placements["square"]
    known = replace(model, placements={"square": square, "posed": replace(square, log_scale=square.log_scale + 0.1)})
    jaxfit.save(known, tmp_path / "known.safetensors")
    evaluate = ["evaluate", str(tmp_path / "known.safetensors"), "--data", "posed:x", "--out"]
    boxes = write_boxes(tmp_path / "boxes.csv", {face.image.name: unlabelled(face).box for face in heads[:5]})
    assert main([*evaluate, str(tmp_path / "a")]) == 0
    assert main([*evaluate, str(tmp_path / "b"), "--boxes", str(boxes), "--box-kind", "posed"]) == 0
    assert main([*evaluate, str(tmp_path / "c"), "--boxes", str(boxes)]) == 0
    assert "does not know" not in capsys.readouterr().out
    own, given, squares = ((tmp_path / name / "faces.csv").read_text() for name in "abc")
    assert own == given != squares


def test_reports_of_2d_models_have_no_poses(formats, drawn: Path, model: Path, tmp_path: Path, capsys) -> None:
    out, spec = tmp_path / "out", f"pts:{drawn}"
    assert main(["evaluate", str(model), "--data", spec, "posed:x", "--normaliser", "box", "--out", str(out)]) == 0
    for report in strictly((out / "report.json").read_text())["datasets"].values():
        assert not {"pose", "nmed_3d"} & set(report)
    rows = rows_of(out / "faces.csv")
    assert {row[name] for row in rows for name in ("nmed_3d", *POSED[:3])} == {""}
    assert {row["true_yaw"] for row in rows if row["dataset"] == spec} == {""}
    assert "" not in {row["true_yaw"] for row in rows if row["dataset"] == "posed:x"}
    said = capsys.readouterr().out
    assert "3D" not in said
    assert "errors of the pose" not in said


@pytest.mark.parametrize("method", ["alignment3d", "regression3d"])
def test_fit_writes_heads(heads, head_models, tmp_path: Path, method: str) -> None:
    jaxfit.save(head_models[method], tmp_path / "heads.safetensors")
    pictures = [face.image for face in heads[:3]]
    squares = [bounding_square(face.landmarks) for face in heads[:3]]
    named = {picture.name: box for picture, box in zip(pictures, squares, strict=True)}
    boxes = write_boxes(tmp_path / "boxes.csv", named | {pictures[1].name: (900, 900, 9, 9)})
    out = tmp_path / "out"
    fit = ["fit", *map(str, pictures), "--model", str(tmp_path / "heads.safetensors"), "--boxes", str(boxes)]
    assert main([*fit, "--out", str(out)]) == 0
    images = [jaxfit.read_image(picture) for picture in pictures]
    fits = jaxfit.fit(head_models[method], images, squares)
    rows, flat = rows_of(out / "heads.csv"), rows_of(out / "landmarks.csv")
    points = [f"{axis}{i}" for i in range(1, 22) for axis in "xyz"]
    modes = [f"b{i}" for i in range(1, fits.b.shape[1] + 1)]
    assert list(rows[0]) == ["image", "face", *POSED[:3], "scale", *points, *modes]
    assert [row["face"] for row in rows] == [row["face"] for row in flat] == [f"{pictures[n].stem}_1" for n in (0, 2)]
    for row, plane, number in zip(rows, flat, (0, 2), strict=True):
        assert row["image"] == plane["image"] == str(pictures[number])
        solid = np.array([float(row[name]) for name in points]).reshape(21, 3)
        np.testing.assert_allclose(solid, fits.landmarks_3d[number], atol=1e-3)
        np.testing.assert_allclose([float(row[name]) for name in POSED[:3]], fits.pose[number], atol=1e-3)
        np.testing.assert_allclose([float(row[name]) for name in modes], fits.b[number], atol=1e-3)
        assert float(row["scale"]) == pytest.approx(fits.scale[number], abs=1e-3)
        seen = np.array([[float(plane[f"{axis}{i}"]) for axis in "xy"] for i in range(1, 22)])
        np.testing.assert_allclose(seen, fits.landmarks[number], atol=1e-3)
        if method == "regression3d":
            np.testing.assert_allclose(solid[:, :2], seen, atol=2e-3)
        overlay = jaxfit.read_image(out / "overlays" / f"{pictures[number].stem}.jpg").astype(float)
        in_3d = draw_head(images[number], fits.landmarks_3d[number], fits.pose[number], AFLW21, squares[number])
        in_2d = draw_landmarks(images[number], fits.landmarks[number], AFLW21, squares[number])
        assert np.abs(overlay - in_3d).mean() < 0.8 * np.abs(overlay - in_2d).mean()  # JPEG blurs colours


def test_2d_models_write_no_heads(drawn: Path, model: Path, tmp_path: Path, capsys) -> None:
    picture = drawn / "face000.png"
    boxes = write_boxes(tmp_path / "boxes.csv", {picture.name: bounding_square(read_pts(picture.with_suffix(".pts")))})
    fit = ["fit", str(picture), "--model", str(model), "--boxes", str(boxes), "--out", str(tmp_path / "out")]
    assert main(fit) == 0
    assert not (tmp_path / "out" / "heads.csv").exists()
    assert "heads.csv" not in capsys.readouterr().out
    for command in (fit, ["evaluate", str(model), "--data", f"pts:{drawn}", *fit[-2:], "--normaliser", "box"]):
        assert main([*command, "--refine"]) == 2
        assert "only models of the method alignment3d" in capsys.readouterr().err


def test_training_on_lifted_labels(heads, head_models, tmp_path: Path, monkeypatch, capsys) -> None:
    """Faces with hidden points join those with all; training itself is left out: it is told what it would get."""
    for face in heads[:3]:
        (tmp_path / face.image.name).write_bytes(face.image.read_bytes())
        write_pts((tmp_path / face.image.name).with_suffix(".pts"), face.landmarks)
    hidden = [replace(face, present=np.arange(21) % 4 > 0) for face in heads[3:9]]
    hidden[5] = replace(hidden[5], present=np.arange(21) < 7)
    monkeypatch.setitem(FORMATS, "hidden", lambda _: Dataset("", AFLW21, tuple(hidden), ("one more was torn",)))
    asked = {}

    def train(faces, scheme, **others):
        asked.update(others, faces=faces, scheme=scheme)
        return jaxfit.Trained(head_models["regression3d"], len(faces), ())

    monkeypatch.setattr("jaxfit.cli.train.train", train)
    head, out = tmp_path / "mine.safetensors", tmp_path / "out.safetensors"
    save_head_model(load_head_model(), head)
    command = [
        "train",
        "--data",
        f"pts:{tmp_path}",
        "--lift",
        "hidden:x",
        "--out",
        str(out),
        "--method",
        "regression3d",
    ]
    assert main([*command, "--head", str(head), "--lift-yaw", "9"]) == 0
    turned = [face for face in hidden[:5] if abs(face.pose[2]) > 9]
    assert 0 < len(turned) < 5
    assert (asked["method"], asked["scheme"], asked["options"].head) == ("regression3d", AFLW21, str(head))
    assert [face.face for face in asked["faces"]] == [face.face for face in [*heads[:3], *turned]]
    for lifted, face in zip(asked["faces"][3:], turned, strict=True):
        assert lifted.complete
        apart = np.linalg.norm(lifted.landmarks - face.landmarks, axis=1)  # hidden ones included
        assert apart.max() < 0.05 * np.ptp(face.landmarks, 0).max()
        np.testing.assert_allclose(lifted.pose, face.pose, atol=5)
    said = capsys.readouterr()
    assert f"hidden:x: {len(turned)} of 6 faces lifted to aflw21" in said.out
    assert f"trained on {3 + len(turned)} faces" in said.out
    for words in ("one more was torn", "1 of 6 faces left out: fewer than 8 labelled points", "turned by less than 9"):
        assert words in said.err
    assert jaxfit.load(out).space_3d is not None

    # A head model knows neither faces without landmarks nor points of unknown meaning.
    monkeypatch.setitem(FORMATS, "hidden", lambda _: Dataset("", NO_LANDMARKS, tuple(map(unlabelled, heads[:2]))))
    assert main(command) == 2
    assert "this head model has no points of scheme none" in capsys.readouterr().err
    assert main([*command, "--head", "nobody"]) == 2
    assert "no head model 'nobody': expected one of the bundled head models" in capsys.readouterr().err


def test_a_person_who_is_lifted_and_shared_is_one_person(heads, tmp_path: Path, monkeypatch) -> None:
    """So that nobody is both learned from and kept aside."""
    for name in ("here", "there"):
        monkeypatch.setitem(FORMATS, name, lambda _: Dataset("", AFLW21, tuple(heads[:4]), ()))
    specs = {"--data": f"here:{tmp_path}", "--lift": "there:x", "--share": "there:x"}
    words = ["finetune", "model", "--out", "out", *(word for option in specs.items() for word in option)]
    faces = read_faces(parser().parse_args(words)).faces
    assert len(faces) == 12
    subjects = [face.subject for face in faces]
    assert subjects[4:8] == subjects[8:]
    assert not set(subjects[:4]) & set(subjects[4:])


def test_fine_tuning_says_what_became_of_the_model(
    drawn: Path, model: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    """Training and teaching themselves are left out."""
    plain = jaxfit.load(model)
    trusted = SimpleNamespace(scheme=plain.scheme, confidence="known")
    tuned = jaxfit.Finetuned(plain, 3, np.array([0.1, 0.2]), ())
    monkeypatch.setattr("jaxfit.cli.finetune.load", lambda _: trusted)
    monkeypatch.setattr("jaxfit.cli.finetune.finetune", lambda *_, **__: tuned)
    assert main(["finetune", str(model), "--data", f"pts:{drawn}", "--out", str(tmp_path / "out.safetensors")]) == 0
    said = capsys.readouterr().out
    assert "no epoch was better than 0.1000" in said
    assert "--confidence learns it anew" in said


def test_too_few_people_are_said_before_the_work(drawn: Path, model: Path, monkeypatch, capsys) -> None:
    for command, work in (["train"], "train"), (["finetune", str(model)], "finetune"):
        monkeypatch.setattr(f"jaxfit.cli.{work}.{work}", None)
        out = str(drawn / "unwritten.safetensors")
        assert main([*command, "--data", f"pts:{drawn}", "--out", out, "--confidence", "999"]) == 2
        assert "from 2 to the number of subjects" in capsys.readouterr().err


def test_training_on_filled_labels_with_a_confidence(heads, head_models, tmp_path: Path, monkeypatch, capsys) -> None:
    """Incomplete faces join the training if asked to, and both it and the confidence learn from the same faces."""
    hidden = [replace(face, present=np.arange(21) % 4 > 0) for face in heads[3:5]]
    faces = (*heads[:3], *hidden)
    monkeypatch.setitem(FORMATS, "some", lambda _: Dataset("", AFLW21, faces))
    learned, taught = [], []

    def train(faces, scheme, **_):
        learned.append([face.face for face in faces if face.complete])
        return jaxfit.Trained(head_models["regression3d"], len(faces), ())

    def learn_confidence(model, faces, folds, **_):
        taught.append((folds, [(face.subject, face.face) for face in faces if face.complete]))
        return replace(model, training=model.training | {"taught": True})

    monkeypatch.setattr("jaxfit.cli.train.train", train)
    monkeypatch.setattr("jaxfit.cli.train.learn_confidence", learn_confidence)
    out = tmp_path / "m.safetensors"
    for more in ([], ["--fill"], ["--fill", "--confidence"], ["--confidence", "5"]):
        assert main(["train", "--data", "some:x", "--out", str(out), *more]) == 0
        assert ("taught" in jaxfit.load(out).training) == ("--confidence" in more)
    names = [face.face for face in faces]
    assert learned == [names[:3], names, names, names[:3]]
    # Who bears one name in two datasets is two people.
    ids = [(f"0/{face.subject}", face.face) for face in faces]
    assert taught == [(3, ids), (5, ids[:3])]
    for folds in ("-1", "0", "1"):
        for option in ("--confidence", "--choose"):
            assert main(["train", "--data", "some:x", "--out", str(out), option, folds]) == 2
            assert f"{option}: expected 2 folds or more" in capsys.readouterr().err


def test_training_with_chosen_options(drawn: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    asked = []

    def choose_options(faces, scheme, *, options, folds, method, **_):
        asked.append((len(faces), options.ridge, folds, method))
        trials = (jaxfit.Trial("ridge", 3.0, 0.04, 0.05, 12, 0.001, True),)
        return jaxfit.Chosen(replace(options, ridge=3.0), trials, folds)

    monkeypatch.setattr("jaxfit.cli.train.choose_options", choose_options)
    out = tmp_path / "m.safetensors"
    train = ["train", "--data", f"pts:{drawn}", "--out", str(out), *TRAIN, "--no-haar"]
    assert main([*train, "--choose", "--ridge", "2"]) == 0
    told = jaxfit.load(out).training
    assert asked == [(told["faces"], 2.0, 3, "sdm")]
    assert (told["ridge"], told["chosen"]["trials"][0]["faces"]) == (3.0, 12)
    said = capsys.readouterr().out
    assert re.search(r"ridge +3 +12 +0\.0400 +0\.0500 +0\.001 +yes", said)
    assert "chosen: ridge 3, variance 0.95, spread 1, windows " in said


def test_training_without_the_pictures_of_the_test(heads, head_models, tmp_path: Path, monkeypatch, capsys) -> None:
    """Training itself is left out: it is told what it would get."""
    elsewhere = [replace(face, image=tmp_path / "cut" / face.image.name, face="other") for face in heads[1:3]]
    monkeypatch.setitem(FORMATS, "drawn", lambda _: Dataset("", AFLW21, heads[:6]))
    monkeypatch.setitem(FORMATS, "tested", lambda _: Dataset("", NO_LANDMARKS, tuple(map(unlabelled, elsewhere))))
    learned = []

    def train(faces, scheme, **_):
        learned.extend(faces)
        return jaxfit.Trained(head_models["regression3d"], len(faces), ())

    monkeypatch.setattr("jaxfit.cli.train.train", train)
    assert main(["train", "--data", "drawn:x", "--without", "tested:x", "--out", str(tmp_path / "m.safetensors")]) == 0
    assert [face.face for face in learned] == [face.face for face in (heads[0], *heads[3:6])]
    assert "2 of 6 faces left out: tested:x has their pictures" in capsys.readouterr().out


def test_3d_methods_need_a_head_model_of_the_landmarks(drawn: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("jaxfit.learning.train.cut", None)  # not reached
    out = tmp_path / "out.safetensors"
    for method in ("alignment3d", "regression3d"):
        train = ["train", "--data", f"pts:{drawn}", "--out", str(out), *TRAIN, "--no-haar", "--method", method]
        assert main(train) == 2
        assert "this head model has no points of scheme points5; it has" in capsys.readouterr().err
    assert not out.exists()
