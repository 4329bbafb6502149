"""The commands, as a user types them: what they write, what they print, and what they say of bad input."""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from drawing import TRAIN

import jaxfit
from jaxfit.cli.main import main
from jaxfit.data.boxes import bounding_square
from jaxfit.data.images import write_image
from jaxfit.data.pts import read_pts, write_pts


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
    train = ["train", "--data", *specs, "--out", str(out), *TRAIN, "--no-haar"]
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
