"""``jaxfit export``: what it writes fits as the model does, and what it says."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxfit
from jaxfit.cascade.fit import fit_crops
from jaxfit.cascade.starts import Starts
from jaxfit.cli.main import main
from jaxfit.fitting.export import load_exported


def test_an_exported_model_fits_as_the_model_does(
    drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "exported.safetensors"
    assert main(["export", str(drawn_model), "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert "in: crops (N, 64, 64) uint8" in printed.out
    assert "out: landmarks (N, 5, 2) float32: crop pixels" in printed.out
    assert printed.err == ""
    loaded = jaxfit.load(drawn_model)
    images = [jaxfit.read_image(path) for path in sorted(drawn.glob("*.png"))[:2]]
    crops, _ = jaxfit.crop_faces(loaded, images, [[35, 35, 50, 50]] * 2)
    found = load_exported(out)(crops.pixels)["landmarks"]
    truth = fit_crops(loaded.cascade, jnp.asarray(crops.pixels))
    np.testing.assert_allclose(found, truth, atol=0.01)


def test_several_starts_are_exported_with_a_warning_if_the_model_was_trained_for_one(
    drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "exported.safetensors"
    arguments = ["--starts", "3", "--rotations", "-45", "45", "--unshift"]
    assert main(["export", str(drawn_model), "--out", str(out), *arguments]) == 0
    said = capsys.readouterr().err
    assert "was trained for a single start" in said
    assert f"--unshift: {drawn_model} knows of no shift of its labels" in said
    assert load_exported(out).starts == Starts(3, -45.0, 45.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing", "--out", "a.safetensors"], "no model 'nothing'"),
        (["sdm68", "--out", "a.npz"], "ending in .safetensors"),
        (["sdm68", "--out", "a.safetensors", "--starts", "2"], "at least three"),
    ],
)
def test_wrong_requests_are_refused_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
