"""Objects that are no faces, by the commands alone: labels as other programs write them, schemes of one's own."""

import json
import re
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from csv_files import read_csv
from drawn_faces import TRAIN, draw_face

import jaxfit
from jaxfit.cli.main import main
from jaxfit.data.pictures import write_image
from jaxfit.labels.datasets import read_dataset
from jaxfit.labels.gather import gather_faces

SCHEME = """
points = ["a", "b", "c", "d", "e"]
lines = [["a", "b"], [3, 4, 5]]
normaliser = ["a", "b"]
unit = "mm"
scale = 0.5
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve drawn objects in a TPS file, ``fly.toml``, and the model that is trained with it."""
    folder = tmp_path_factory.mktemp("objects")
    rng = np.random.default_rng(0)
    specimens = ""
    for number in range(12):
        picture, points = draw_face(rng)
        write_image(folder / f"o{number}.png", picture)
        rows = "".join(f"{x:.2f} {120 - y:.2f}\n" for x, y in points)
        specimens += f"LM=5\n{rows}IMAGE=o{number}.png\nID={number}\n"
    (folder / "l.tps").write_text(specimens + "LM=0\nIMAGE=o0.png\n")
    (folder / "fly.toml").write_text(SCHEME)
    options = ["--scheme", str(folder / "fly.toml"), "--out", str(folder / "fly.safetensors"), *TRAIN, "--folds", "2"]
    with (
        redirect_stdout(StringIO()) as out,
        redirect_stderr(StringIO()) as warnings,
    ):
        assert main(["train", "--data", str(folder / "l.tps"), *options]) == 0
    (folder / "out.txt").write_text(out.getvalue() + warnings.getvalue())
    return folder


def test_training_says_what_errors_it_leaves_on_others_and_that_faces_are_few(folder: Path) -> None:
    said = (folder / "out.txt").read_text()
    for start in ("whole pictures", "boxes like those around landmarks"):
        found = re.search(
            rf"did not learn from, in 2 folds, from {start}: mean error (0\.\d+), .* ([\d.]+) pixels", said
        )
        assert found, said
        assert 0.1 < float(found[2]) < 6
    assert "only 12 faces to learn from" in said


@pytest.mark.parametrize(("folds", "expected"), [("1", "expected 2 folds or more"), ("13", "number of subjects, 12")])
def test_wrong_folds_are_refused_before_the_work(
    folds: str, expected: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train = ["train", "--data", str(folder / "l.tps"), "--out", str(folder / "no.safetensors"), "--folds", folds]
    assert main(train) == 2
    assert expected in capsys.readouterr().err


def test_models_keep_what_a_scheme_says(folder: Path) -> None:
    scheme = jaxfit.load(folder / "fly.safetensors").scheme
    assert (scheme.name, scheme.names, scheme.mirror) == ("fly", ("a", "b", "c", "d", "e"), None)
    assert (scheme.lines, scheme.ends, scheme.unit) == (((0, 1), (2, 3, 4)), (0, 1), "mm")


@pytest.mark.parametrize("start", [[], ["--detector", "whole"]], ids=["squares", "whole"])
def test_errors_in_units(start: list[str], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = ["--data", f"tps:{folder / 'l.tps'}", "--scheme", str(folder / "fly.toml")]
    assert main(["evaluate", str(folder / "fly.safetensors"), *data, *start, "--out", str(tmp_path / "out")]) == 0
    (report,) = json.loads((tmp_path / "out" / "report.json").read_text())["datasets"].values()
    assert report["normaliser"] == "the scheme's pair of points"
    assert report["units"]["unit"] == "mm"
    assert report["units"]["mean"] == pytest.approx(0.5 * report["pixels"]["mean"], abs=1e-3)
    assert report["pixels"]["mean"] < 4
    assert list(report["pixels_of_landmarks"]) == ["a", "b", "c", "d", "e"]
    assert "errors of single landmarks in mm" in capsys.readouterr().out


def test_whole_pictures_are_fitted_and_go_back_to_the_labelling_program(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    pictures = [str(folder / f"o{number}.png") for number in range(3)]
    formats = ["--format", "csv", "tps", "imglab", "coco", "--no-overlays"]
    assert main(["fit", *pictures, "--model", str(folder / "fly.safetensors"), "--out", str(out), *formats]) == 0
    rows = read_csv(out / "landmarks.csv")
    assert [row["box"] for row in rows] == ["whole"] * 3
    points = np.array([[[float(row[f"{axis}{n}"]) for axis in "xy"] for n in range(1, 6)] for row in rows])
    for name, tolerance in {"landmarks.tps": 2e-3, "landmarks.xml": 0.5, "keypoints.json": 1e-9}.items():
        found = read_dataset(str(out / name))
        assert not found.problems
        assert [face.image.resolve() for face in found.faces] == [Path(picture).resolve() for picture in pictures]
        np.testing.assert_allclose([face.landmarks for face in found.faces], points, atol=tolerance)


def test_suggested_pictures_come_with_labels_to_correct(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "next.tps"
    pictures = [str(folder / f"o{number}.png") for number in range(5)]
    suggest = ["suggest", str(folder / "fly.safetensors"), *pictures, "--out", str(out), "--count"]
    assert main([*suggest, "3"]) == 0
    faces = read_dataset(str(out)).faces
    labelled = {face.image.resolve(): face for face in read_dataset(str(folder / "l.tps")).faces if face.complete}
    assert len({face.image for face in faces}) == len(faces) == 3
    for face in faces:
        assert np.abs(face.landmarks - labelled[face.image.resolve()].landmarks).mean() < 4
    assert main([*suggest, "0"]) == 2


def test_labels_without_names_are_taken_for_the_models(folder: Path) -> None:
    scheme = jaxfit.load(folder / "fly.safetensors").scheme
    data = [f"tps:{folder / 'l.tps'}"]
    assert gather_faces(data, scheme_of_model=scheme).scheme == scheme
    assert gather_faces(data).scheme.name == "points5"
    assert gather_faces(data, scheme="{mirror = [[1, 2]]}", scheme_of_model=scheme).scheme.mirror == (1, 0, 2, 3, 4)
