"""Fits of models whose labels lay beside what they mark, moved onto it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxfit
from jaxfit.cli import serve
from jaxfit.cli.main import main
from jaxfit.errors import InputError
from jaxfit.fitting.pipeline import Pipeline
from jaxfit.runs import BatchFitter, workers

SHIFT = 1.5
BOXES = np.array([[36.0, 41.0, 48.0, 48.0], [30.0, 44.0, 50.0, 50.0]])


def shifted(path: Path) -> jaxfit.Model:
    """The model, as if its labels had lain beside what they mark."""
    model = jaxfit.load(path)
    return replace(model, cascade=replace(model.cascade, frame=replace(model.cascade.frame, shift=SHIFT)))


@pytest.mark.parametrize("rotation", [0.0, 30.0])
def test_fits_move_by_the_shift(rotation: float, drawn: Path, drawn_model: Path) -> None:
    model = shifted(drawn_model)
    pictures = [drawn / "face000.png", drawn / "face001.png"]
    turned = np.full(2, rotation)
    angle = np.radians(rotation)
    along = SHIFT * np.array([np.cos(angle) - np.sin(angle), np.cos(angle) + np.sin(angle)])  # the crop's axes
    fits = jaxfit.fit(model, pictures, BOXES, rotations=turned)
    # From boxes that lie on the face as these do on its labels.
    moved = jaxfit.fit(model.unshifted(), pictures, BOXES - [*along, 0, 0], rotations=turned)
    np.testing.assert_allclose(moved.landmarks, fits.landmarks - along, atol=1e-3)


def test_tables_of_the_command(drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    jaxfit.save(shifted(drawn_model), tmp_path / "shifted.safetensors")
    (tmp_path / "boxes.csv").write_text("image,x,y,width,height\nface000.png,36,41,48,48\n")
    found = {}
    for model, option in (("shifted", []), ("shifted", ["--unshift"]), ("plain", ["--unshift"])):
        path = drawn_model if model == "plain" else tmp_path / "shifted.safetensors"
        out = tmp_path / f"{model}{len(option)}"
        request = [str(drawn / "face000.png"), "--model", str(path), "--boxes", str(tmp_path / "boxes.csv")]
        assert main(["fit", *request, "--out", str(out), "--no-overlays", *option]) == 0
        _, row = (out / "landmarks.csv").read_text().splitlines()
        found[model, len(option)] = np.array(row.split(",")[-10:], float)  # of five landmarks
        assert ("knows of no shift" in capsys.readouterr().err) == (model == "plain")
    assert 0.5 < np.abs(found["shifted", 0] - found["shifted", 1]).max() < 3.0


def test_workers_and_the_page_move_fits_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What fits and serves is replaced: this looks at the models that it gets."""
    shifts = []

    def stream(pipeline: Pipeline, *_: Any) -> list[jaxfit.Fits]:
        shifts.append(pipeline.model.cascade.frame.shift)
        return [jaxfit.fit(pipeline.model, [])]

    def service(models: dict[str, jaxfit.Model], _: Any) -> None:
        shifts.extend(model.cascade.frame.shift for model in models.values())
        raise InputError("seen")

    monkeypatch.setattr(workers, "stream", stream)
    monkeypatch.setattr(serve, "Service", service)
    for unshift in (False, True):
        BatchFitter("face68", jaxfit.Fitting("whole"), unshift=unshift)({"image": []})
        assert main(["serve", "--model", "face68", "sdm68", "--detector", "whole", *["--unshift"] * unshift]) == 2
    shift = jaxfit.load("face68").cascade.frame.shift
    assert shift > 0
    assert shifts == [shift, shift, 0, 0, 0, 0]
    assert "--unshift changes nothing for sdm68: no shift of their labels is known" in capsys.readouterr().err
