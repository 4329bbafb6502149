"""Scripts that make the documents' folders and the bundled models."""

import sys
from pathlib import Path

import numpy as np
import pytest
from script_runner import SCRIPTS, load, run

import jaxfit
from jaxfit.cli.main import main as jaxfit_main
from jaxfit.cli.main import parser
from jaxfit.data.pictures import write_image
from jaxfit.data.pts import write_pts
from jaxfit.errors import InputError
from jaxfit.models.files import bundled


def labelled_people(folder: Path) -> Path:
    """Eight people with three pictures each."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for person in range(8):
        for picture in range(3):
            write_image(folder / f"p{person}_{picture}.png", np.zeros((20, 20), np.uint8))
            write_pts(folder / f"p{person}_{picture}.pts", rng.uniform(2, 18, (68, 2)))
    return folder


def test_splits_never_split_a_person(tmp_path: Path) -> None:
    faces = labelled_people(tmp_path / "faces")
    assert run("split", "--data", f"pts:{faces}", "--folds", "4", "--out", str(tmp_path)) == 0
    train, test = (jaxfit.read_dataset(f"pts:{tmp_path / part / 'faces'}").faces for part in ("train", "test"))
    assert (len(train), len(test)) == (18, 6)
    assert not {face.subject for face in train} & {face.subject for face in test}
    of_all = {face.face: face.landmarks for face in jaxfit.read_dataset(f"pts:{faces}").faces}
    np.testing.assert_array_equal(test[0].landmarks, of_all[test[0].face])


def test_splits_touch_no_files_that_are_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of another split, which would put people into both parts, or the dataset's own."""
    faces = labelled_people(tmp_path / "faces")
    for data, fold in ((faces, "0"), (faces, "1"), (tmp_path / "train" / "faces", "0")):
        files = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
        first = not (tmp_path / "train").exists()
        command = ["--data", f"pts:{data}", "--fold", fold, "--folds", "4", "--out", str(tmp_path)]
        assert run("split", *command) == (0 if first else 2)
        if not first:
            assert "delete them" in capsys.readouterr().err
            assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == files


@pytest.mark.parametrize("wrong", [["--fold", "5"], ["--folds", "9"], ["--data", "lfpw:somewhere"]])
def test_splits_refuse_what_they_cannot_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: list[str]
) -> None:
    faces = labelled_people(tmp_path / "faces")
    assert run("split", "--data", f"pts:{faces}", *wrong, "--out", str(tmp_path / "out")) == 2
    assert "jaxfit: error: " in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def dry_run(capsys: pytest.CaptureFixture[str], *options: str) -> list[list[str]]:
    """The commands that building would run, in words."""
    assert run("build_models", "--data", "D", "--out", "O", "--dry-run", *options) == 0
    return [line.removeprefix("$ ").split() for line in capsys.readouterr().out.splitlines()]


def test_every_bundled_model_is_built_by_commands_that_exist(capsys: pytest.CaptureFixture[str]) -> None:
    commands = dry_run(capsys)
    written = [words[words.index("--out") + 1] if "--out" in words else words[2] for words in commands]
    assert {f"O/{name}.safetensors" for name in bundled()} <= set(written)
    assert len(set(written)) == len(written)
    for program, *words in commands:
        if program == "jaxfit":
            parser().parse_args(words)  # exits where it does not know an option
        else:
            assert (SCRIPTS.parent / program).is_file()


def test_people_kept_aside_are_measured_and_not_learned_from(capsys: pytest.CaptureFixture[str]) -> None:
    *built, kept_aside, turned = dry_run(capsys, "sdm68", "--split", "S")
    assert {word for words in built for word in words if word.startswith("pts:")} == {
        f"pts:S/train/{name}" for name in ("lfpw68", "helen68", "ytf68")
    }
    assert "pts:S/test/ytf68" in kept_aside
    assert "aflw2000:D/aflw2000" in turned


def test_unknown_models_are_not_built(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("build_models", "face99", "--data", "D", "--out", str(tmp_path / "O")) == 2
    assert "got face99" in capsys.readouterr().err
    assert not (tmp_path / "O").exists()


def test_what_fails_stops_the_building(tmp_path: Path) -> None:
    failed = jaxfit_main(["train", "--data", f"pts:{tmp_path}", "--out", "x.safetensors"])
    assert run("build_models", "sdm68", "--data", str(tmp_path), "--out", str(tmp_path)) == failed == 2


def test_sizes_of_installed_packages_count_all_their_files(tmp_path: Path) -> None:
    (tmp_path / "package" / "inner").mkdir(parents=True)
    (tmp_path / "package" / "inner" / "a.bin").write_bytes(bytes(300))
    (tmp_path / "package" / "b.bin").write_bytes(bytes(20))
    installing = load("installing")
    assert installing.size_of(tmp_path / "package") == 320
    assert installing.size_of(tmp_path / "package" / "b.bin") == 20


def test_a_step_of_installing_that_fails_says_which_and_why(tmp_path: Path) -> None:
    failing = [sys.executable, "-c", "import sys; print('no such package'); sys.exit(3)"]
    with pytest.raises(InputError, match=r"pip install ended with 3:\nno such package"):
        load("installing").ended("pip install", failing, tmp_path)
