"""``jaxfit compare``: that it is ``evaluate`` of several, what it writes and what it refuses."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from csv_files import read_csv

import jaxfit
from jaxfit.cli.main import main
from jaxfit.experiments.comparison import worst_faces
from jaxfit.fitting.export import export_model
from jaxfit.labels.datasets import read_dataset

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")


@pytest.fixture
def fits_file(drawn: Path, tmp_path: Path) -> Path:
    """Another program's fits of half of the drawn faces, a pixel beside the labels."""
    faces = read_dataset(f"pts:{drawn}").faces
    count = len(faces[0].landmarks)
    rows = [[face.image.name, *(face.landmarks + [1, 0]).ravel()] for face in faces[::2]]
    with (tmp_path / "theirs.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([["image", *(f"{axis}{n}" for n in range(1, count + 1) for axis in "xy")], *rows[::-1]])
    return tmp_path / "theirs.csv"


def test_a_model_is_measured_as_by_evaluate(
    drawn: Path, drawn_model: Path, fits_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("flatbuffers")
    export_model(jaxfit.load(drawn_model), tmp_path / "exported.safetensors")
    data = ["--data", f"pts:{drawn}"]
    assert main(["evaluate", str(drawn_model), *data, "--out", str(tmp_path / "alone")]) == 0
    contestants = [f"mine={drawn_model}", f"theirs={fits_file}", str(tmp_path / "exported.safetensors")]
    assert main(["compare", *contestants, *data, "--out", str(tmp_path / "all")]) == 0
    alone, together = (read_csv(tmp_path / name / "faces.csv") for name in ("alone", "all"))
    assert [row["nmed mine"] for row in together] == [row["nmed"] for row in alone]
    own, exported = (np.array([float(row[f"nmed {name}"]) for row in together]) for name in ("mine", "exported"))
    np.testing.assert_allclose(exported, own, atol=2e-5)
    theirs = [float(row["nmed theirs"]) for row in together]
    assert np.isinf(theirs[1::2]).all()
    assert np.isfinite(theirs[::2]).all()
    report = json.loads((tmp_path / "alone" / "report.json").read_text())["datasets"][f"pts:{drawn}"]
    errors, intervals, tests = (
        read_csv(tmp_path / "all" / "tables" / f"{name}.csv") for name in ("errors", "intervals", "tests")
    )
    # The model learned from these pictures, and is marked.
    assert [row["contestant"] for row in errors] == ["mine †", "theirs", "exported"]
    assert [row["learned from"] for row in errors] == ["24", "unknown", "unknown"]
    assert [row["no fit"] for row in errors] == ["0", "12", "0"]
    assert float(errors[0]["median"]) == pytest.approx(report["nmed"]["median"])
    assert float(errors[0]["± 95 %"]) == pytest.approx(report["nmed"]["ci95"])
    for name, column in (("mean", "mean"), ("median", "median"), ("auc_0.08", "AUC"), ("failure_0.08", "failure")):
        ends = [float(intervals[0][f"{column} {end}"]) for end in ("from", "to")]
        assert ends == pytest.approx(report["intervals"][name])
    assert [(row["first"], row["second"]) for row in tests] == [
        ("mine †", "theirs"),
        ("mine †", "exported"),
        ("theirs", "exported"),
    ]
    assert float(tests[0]["effect size"]) > 0
    sure = float(tests[0]["signed-rank p (Holm)"]) < 0.05
    assert tests[0]["better"] == ("mine †" if sure else "neither")
    printed = capsys.readouterr().out
    assert "models start from boxes around the labels, and miss no face" in printed
    assert "bounding square" in printed
    page = (tmp_path / "all" / "report.html").read_text()
    assert "Worst faces" in page
    assert (tmp_path / "all" / "tables" / "tests.tex").exists()
    listed = json.loads((tmp_path / "all" / "manifest.json").read_text())["files"]
    assert any(name.startswith("figures/ced-") for name in listed)


def test_what_cannot_be_compared_is_refused(
    drawn: Path, fits_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--data", f"pts:{drawn}", "--out", str(tmp_path / "out")]
    for more, message in (
        (["--protocol", "aflw2000", "--normaliser", "box"], "--protocol, which says what errors are relative to"),
        (["--protocol", "aflw2000"], "aflw2000 is about faces of 68 points"),
        (["--detector", "yunet"], "got only files of fits"),
    ):
        assert main(["compare", str(fits_file), *out, *more]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_worst_faces_are_each_ones_in_turn() -> None:
    errors = {"a": np.array([0.1, 0.5, np.inf, 0.2, np.nan]), "b": np.array([0.9, 0.1, 0.3, 0.2, np.nan])}
    assert worst_faces(errors, 9) == [1, 0, 3, 2]
    assert worst_faces(errors, 2) == [1, 0]
    assert worst_faces({"a": np.full(3, np.inf)}, 2) == [0, 1]


def test_without_what_draws_the_page_nothing_is_begun(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("jaxfit.experiments.page.find_spec", lambda name: None)
    assert main(["compare", "face68", "fast68", "--data", "pts:nowhere", "--out", str(tmp_path / "out")]) == 2
    assert 'need jinja2 and matplotlib: pip install "jaxfit[experiments]"' in capsys.readouterr().err
