"""The sample that comes with the package, the command that fits it, and the one that says what is installed."""

import sys
from pathlib import Path

import pytest

import jaxfit
from jaxfit.cli import doctor
from jaxfit.cli.main import main
from jaxfit.errors import InputError


def test_the_sample_is_a_picture() -> None:
    assert jaxfit.read_image(jaxfit.sample("portrait")).shape == (600, 512, 3)
    assert jaxfit.sample() == jaxfit.sample("portrait")
    with pytest.raises(InputError, match="no sample picture 'wing'; expected one of portrait"):
        jaxfit.sample("wing")


def test_the_demo_needs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    said = capsys.readouterr().out
    assert "faces fitted: 1" in said
    picture = tmp_path / "demo" / "overlays" / "portrait.jpg"
    assert f"Look at {picture.relative_to(tmp_path)}" in said
    assert picture.is_file()
    assert (tmp_path / "demo" / "heads.csv").is_file()


def test_the_doctor_says_that_all_is_well(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    for part in (f"jaxfit {jaxfit.__version__:>10}".split()[0], "Python", "jax", "devices", "detectors", "jaxfit[ray]"):
        assert part in said
    assert "WRONG" not in said
    assert "68 landmarks in" in said


def test_the_doctor_finds_what_is_wrong(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(doctor, "_TOLERANCE", 0.001)
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    assert main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert said.count("WRONG") == 1
    assert 'not installed: pip install "jaxfit[heif]"' in said


def test_the_doctor_survives_a_fit_that_ends_in_any_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*arguments: object) -> None:
        raise RuntimeError("no memory")

    monkeypatch.setattr(jaxfit, "fit", fail)
    assert main(["doctor"]) == 1
    assert "RuntimeError: no memory  WRONG" in capsys.readouterr().out


def test_the_demo_names_no_overlay_that_it_could_not_make(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("jaxfit.cli.demo.fit.run", lambda options: 1)
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 1
    assert "Look at" not in capsys.readouterr().out


def test_exit_codes_are_documented(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    said = " ".join(capsys.readouterr().out.split())
    for words in ("exit codes: 0 the command did", "1 no face could be fitted", "2 a wrong request", "130 stopped"):
        assert words in said


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_shells_complete_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("shtab")
    assert main(["completion", shell]) == 0
    said = capsys.readouterr().out
    assert all(word in said for word in ("finetune", "--confidence", "doctor"))


def test_completion_without_its_extra(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert 'pip install "jaxfit[completion]"' in capsys.readouterr().err
