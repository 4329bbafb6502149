"""``jaxfit finetune``: what it prints of the model that it tuned."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import jaxfit
from jaxfit.cli.main import main
from jaxfit.learning.finetune import Finetuned


def test_what_is_printed_of_the_tuned_model(
    drawn: Path,
    drawn_model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Tuning itself is replaced."""
    plain = jaxfit.load(drawn_model)
    trusted = SimpleNamespace(scheme=plain.scheme, confidence="known")
    tuned = Finetuned(plain, 3, np.array([0.1, 0.2]), ())
    monkeypatch.setattr("jaxfit.cli.finetune.load", lambda _: trusted)
    monkeypatch.setattr("jaxfit.cli.finetune.finetune", lambda *_, **__: tuned)
    assert (
        main(["finetune", str(drawn_model), "--data", f"pts:{drawn}", "--out", str(tmp_path / "out.safetensors")]) == 0
    )
    said = capsys.readouterr().out
    assert "no epoch was better than 0.1000" in said
    assert "--confidence learns it anew" in said
