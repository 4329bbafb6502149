"""Scripts that compare models and ways to use them, run on drawn heads."""

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from drawn_heads import OPTIONS
from script_runner import load, run

import jaxfit
from jaxfit.data.boxes import bounding_square, jitter
from jaxfit.data.pictures import read_image, write_image
from jaxfit.data.pts import write_pts
from jaxfit.evaluation.errors import nmed
from jaxfit.labels.records import FaceRecord
from jaxfit.learning import learn_confidence
from jaxfit.schemes.known import AFLW21


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, heads: tuple[FaceRecord, ...]) -> Path:
    """Some of the drawn heads as `.pts` files, and two models: one has learned, the other hardly."""
    folder = tmp_path_factory.mktemp("compared")
    (folder / "heads").mkdir()
    for face in heads[:12]:
        write_image(folder / "heads" / face.image.name, read_image(face.image))
        write_pts(folder / "heads" / f"{face.image.stem}.pts", face.landmarks)
    for name, ridge in (("good", OPTIONS.greedy.ridge), ("poor", 1000.0)):
        model = jaxfit.train(heads, AFLW21, options=OPTIONS.but(ridge=ridge)).model
        jaxfit.save(model, folder / f"{name}.safetensors")
    return folder


def rows_of(table: str) -> list[list[str]]:
    lines = [line for line in table.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("| ").split("|")] for line in lines[2:]]


def test_models_are_compared_by_their_errors(folder: Path) -> None:
    page = folder / "page.md"
    page.write_text("Before.\n\n<!-- figures -->\nold\n<!-- end of figures -->\n\nAfter.\n")
    models = [str(folder / f"{name}.safetensors") for name in ("poor", "good")]
    arguments = [*models, "--data", f"pts:{folder / 'heads'}", "--report", str(page)]
    assert run("compare_models", *arguments) == 0
    text = page.read_text()
    assert text.startswith("Before.\n")
    assert text.endswith("After.\n")
    assert "old" not in text
    assert f"```\npython scripts/compare_models.py {' '.join(arguments)}\n```" in text
    assert f"jaxfit {jaxfit.__version__}, jax {jax.__version__}, numpy" in text
    poor, good = rows_of(text)
    assert (poor[0], good[0], poor[-1]) == ("poor", "good", "-")
    assert float(good[2]) < 0.7 * float(poor[2])
    assert float(good[3]) > float(poor[3])
    assert float(good[-1]) < 0.01
    measured = jaxfit.fit(jaxfit.load(models[1]), *boxes_as_given(folder)).landmarks
    truth = np.stack([face.landmarks for face in heads_of(folder)])
    assert float(good[2]) == pytest.approx(np.median(nmed(measured, truth, AFLW21)), abs=6e-5)


def heads_of(folder: Path) -> tuple[FaceRecord, ...]:
    return jaxfit.read_dataset(f"pts:{folder / 'heads'}").faces


def boxes_as_given(folder: Path) -> tuple[list[Path], np.ndarray]:
    """Pictures and boxes of a comparison, as its page says that they are."""
    rng = np.random.default_rng(0)
    faces = heads_of(folder)
    return [face.image for face in faces], np.stack([jitter(bounding_square(face.landmarks), rng) for face in faces])


def test_hard_faces_are_told_apart(folder: Path) -> None:
    page = folder / "hard.md"
    models = [f"{name}={folder / f'{name}.safetensors'}" for name in ("good", "poor")]
    assert run("hard_faces", *models, "--data", f"pts:{folder / 'heads'}", "--report", str(page)) == 0
    text = page.read_text()
    good, poor = rows_of(text)[:2]
    assert float(good[1]) < 0.7 * float(poor[1])
    assert float(poor[-1]) < 0.01
    faces = heads_of(folder)
    errors = load("hard_faces").errors_of(
        {"good": jaxfit.load(folder / "good.safetensors")}, jaxfit.read_dataset(f"pts:{folder / 'heads'}"), read_image
    )["good"]
    assert float(good[1]) == pytest.approx(errors.mean(), abs=6e-5)
    for what in ("by yaw", "side of the face", "sharpness", "light"):
        assert f"{what}" in text
    quarters = text.split("side of the face")[1].split("All data sets")[0]
    means = [float(cell.split(" / ")[0]) for cell in rows_of(quarters)[0][1:]]
    assert np.mean(means) == pytest.approx(errors.mean(), rel=0.2)
    assert len(faces) == 12


def test_models_of_one_name_cannot_be_compared(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = str(folder / "good.safetensors")
    assert run("compare_models", model, model, "--data", f"pts:{folder / 'heads'}") == 2
    assert "expected models of different names" in capsys.readouterr().err


def test_fusion_needs_a_confidence(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("fusion", str(folder / "good.safetensors"), "--data", f"pts:{folder / 'heads'}") == 2
    assert "expected a model with a confidence" in capsys.readouterr().err


def test_faces_with_missing_points_teach_and_are_tested(
    heads: tuple[FaceRecord, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    hidden = [
        replace(face, landmarks=np.where(known[:, None], face.landmarks, np.nan), present=known) if number % 2 else face
        for number, face in enumerate(heads)
        if (known := np.arange(21) != number % 21).any()
    ]
    script, report = load("missing_points"), load("report").Report()
    monkeypatch.setattr(script, "training_options", lambda arguments, scheme, method: OPTIONS)
    models = script.trained(hidden, AFLW21, Namespace(epochs=2, seed=0, head_model=OPTIONS.head_model))
    assert [name.rpartition(" (")[2] for name in models] == ["16)", "16)", "32)", "32)", "32)"]
    script.add_tests(report, models, hidden, AFLW21)
    above, complete, _, by_yaw = report.parts
    assert [row[0] for row in rows_of(complete)] == list(models) == [row[0] for row in rows_of(by_yaw)]
    assert "Complete faces (16)" in above
    assert all(0 < float(row[1]) < 0.1 for row in rows_of(complete))


def test_own_objects_are_measured_in_folds(folder: Path) -> None:
    page = folder / "own.md"
    arguments = ["--data", f"pts:{folder / 'heads'}", "--folds", "2", "--pixel", "0.5", "--within", "1e6"]
    assert run("own_objects", *arguments, "--train", "quick=--copies 0", "--part", "heads", "--report", str(page)) == 0
    text = page.read_text()
    assert "<!-- figures: heads -->" in text
    rows = rows_of(text)
    assert [row[:2] for row in rows] == [["quick", start] for start in load("own_objects").STARTS[: len(rows)]]
    for row in rows:
        of_box, pixels, length, within = map(float, row[2:6])
        assert 0 < of_box < 0.3
        assert length == pytest.approx(pixels / 2, abs=0.01)
        assert within == 100


def test_uncertainties_are_measured(folder: Path, heads: tuple[FaceRecord, ...]) -> None:
    taught = learn_confidence(jaxfit.load(folder / "good.safetensors"), heads, folds=2)
    jaxfit.save(taught, folder / "taught.safetensors")
    page = folder / "uncertainty.md"
    model, data = str(folder / "taught.safetensors"), f"pts:{folder / 'heads'}"
    assert run("uncertainty", model, "--data", data, "--report", str(page)) == 0
    tables = [part for part in page.read_text().split("\n\n") if part.startswith("|")]
    all_faces, covers, fused = (rows_of(table)[0] for table in tables)
    assert int(all_faces[2]) == 12 * 21
    assert all(0 <= float(share) <= 1 for share in all_faces[3:6])
    assert 0 < float(covers[1]) < 30
    assert len(fused) == 6
    assert run("uncertainty", str(folder / "good.safetensors"), "--data", data) == 2
