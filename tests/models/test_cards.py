"""The list of bundled models: every one has its card, short and long, and the command tells what the files say."""

import re
from pathlib import Path

import jaxfit
from jaxfit.cli.main import main
from jaxfit.models.cards import read_cards
from jaxfit.models.files import DEFAULT_MODEL

ROOT = Path(__file__).resolve().parents[2]


def test_every_model_has_a_card() -> None:
    assert {*read_cards()} == {*jaxfit.bundled()}
    for name in jaxfit.bundled():
        card = (ROOT / "docs" / "reference" / "models" / f"{name}.md").read_text(encoding="utf-8")
        assert card.startswith(f"# Model card: `{name}`")
        for heading in ("## Data and terms", "## Accuracy", "## Limits"):
            assert heading in card, name


def test_models_are_listed_and_described(capsys, tmp_path: Path) -> None:
    assert main(["models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(DEFAULT_MODEL)
    assert sorted(line.split()[0] for line in lines if " MB  " in line) == sorted(jaxfit.bundled())
    assert main(["models", *jaxfit.bundled()]) == 0
    described = dict(re.findall(r"^(\S+)\n((?:  .*\n?)+)", capsys.readouterr().out, re.MULTILINE))
    for name in jaxfit.bundled():
        model = jaxfit.load(name)
        assert f"{model.scheme.count} ({model.scheme.name})" in described[name]
        assert ("3D shape and pose" in described[name]) == (model.space_3d is not None)
        assert all(kind in described[name] for kind in model.known_placements)
    assert main(["models", "nobody"]) == 2
    assert "no model 'nobody'" in capsys.readouterr().err
    own = tmp_path / "mine.safetensors"
    jaxfit.save(jaxfit.load("fast68"), own)
    assert main(["models", str(own)]) == 0
    assert "68 (ibug68)" in capsys.readouterr().out
