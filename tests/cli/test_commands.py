"""What all commands have in common: bad input ends them at once, in one line that says what to do."""

import argparse
import re
from dataclasses import fields
from pathlib import Path

import pytest
from drawn_faces import TRAIN

from jaxfit.cascade.greedy import Greedy
from jaxfit.cli.arguments import add_training, given_greedy
from jaxfit.cli.main import main


def test_wrong_requests_stop_at_once_and_say_what_to_do(
    drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    bad_boxes = tmp_path / "bad.csv"
    bad_boxes.write_text("image,x,y\na.png,1,2\n")
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(drawn_model.read_bytes()[:1000])
    data, out = f"pts:{drawn}", str(tmp_path / "out")
    requests = {
        "FORMAT:PATH": ["evaluate", str(drawn_model), "--data", str(drawn), "--out", out],
        "no pictures in": ["fit", str(empty), "--model", str(drawn_model), "--out", out],
        "no such file": ["fit", str(tmp_path / "nowhere.jpg"), "--model", str(drawn_model), "--out", out],
        "expected the columns": ["evaluate", str(drawn_model), "--data", data, "--normaliser", "box"]
        + ["--boxes", str(bad_boxes), "--out", out],
        "damaged": ["evaluate", str(damaged), "--data", data, "--out", out],
        "no model 'nothing'": ["evaluate", "nothing", "--data", data, "--out", out],
        "has no normaliser 'outer'": ["evaluate", str(drawn_model), "--data", data, "--normaliser", "outer"]
        + ["--out", out],
        "give that file too": ["fit", str(drawn), "--model", str(drawn_model), "--box-kind", "x", "--out", out],
        ".safetensors in a folder that can be written to": ["train", "--data", data]
        + ["--out", str(tmp_path / "model.npz")],
        "augmentations >= 1": ["train", "--data", data, "--out", f"{out}.safetensors", *TRAIN, "--augmentations", "0"],
        "pts": ["train", "--data", f"pts:{empty}", "--out", f"{out}.safetensors"],
        "cannot convert landmarks from points5 to aflw21": ["evaluate", str(drawn_model), "--data", data]
        + ["--scheme", "aflw21", "--out", out],
    }
    for words, request in requests.items():
        assert main(request) == 2, request
        said = capsys.readouterr().err
        assert "jaxfit: error:" in said, request
        assert words in said, request
    assert not (tmp_path / "out.safetensors").exists()


def test_options_of_greedy_training_are_its_fields() -> None:
    command = argparse.ArgumentParser()
    add_training(command)
    assert given_greedy(command.parse_args([])) == Greedy()
    values = {"windows": ["0.3", "0.2"], "augmentations": ["2"], "variance": ["0.8"], "ridge": ["0.5"]}
    values |= {"rank": ["3"], "spread": ["1.5"], "seed": ["7"], "copies": ["4"]}
    assert list(values) == [field.name for field in fields(Greedy)]
    words = [word for name, given in values.items() for word in (f"--{name}", *given)]
    assert given_greedy(command.parse_args(words)) == Greedy((0.3, 0.2), 2, 0.8, 0.5, 3, 1.5, 7, 4)


def test_numbers_of_the_command_line_are_those_of_all_programs(capsys: pytest.CaptureFixture[str]) -> None:
    for option, value in {"--score": "0_1", "--starts": "1_1", "--smallest": "４０"}.items():
        with pytest.raises(SystemExit):
            main(["fit", "a.jpg", "--out", "out", option, value])
        assert f"argument {option}: invalid" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ("evaluate --data pts:x model --out out", "--data takes all words that follow, .*: put MODEL before it"),
        ("fit --format csv photos --out out", "--format takes all words that follow, .*: put other words before it"),
        ("fit --out out --format csv photos", "'photos'.*: put other words before it"),
        ("fit --out out", "required: IMAGE_OR_DIR$"),
        ("evaluate model --out out", "required: --data$"),
        ("fit a.jpg --detctor yunet --out out", "unrecognized arguments: --detctor yunet"),
        ("evaluate face68 fast68 --data pts:lab --out out", "unrecognized arguments: fast68"),
    ],
)
def test_words_that_an_option_took_are_said(request_: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(request_.split())
    wrong, help_, *rest = capsys.readouterr().err.splitlines()
    assert re.search(words, wrong)
    assert help_ == f"see jaxfit {request_.split()[0]} --help"
    assert not rest


@pytest.mark.parametrize(("request_", "listed"), [("", "  fit        find landmarks"), ("experiments", "  run  ")])
def test_commands_are_listed_where_one_is_missing(
    request_: str, listed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(request_.split())
    said = capsys.readouterr()
    assert (ended.value.code, said.out) == (2, "")
    assert listed in said.err
    assert "error" not in said.err


def test_a_collection_warns_as_a_folder_run_does_and_leaves_the_model_to_its_workers(
    drawn: Path, drawn_model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = {"fitted": 1, "none": 0, "problem": 0, "missing": 0}
    monkeypatch.setattr("jaxfit.cli.collect.fit_collection", lambda *arguments, **options: outcomes)
    monkeypatch.setattr("jaxfit.models.files._parse", None)
    asked = ["--starts", "3", "--unshift", "--out", "unwritten"]
    assert main(["collect", str(drawn), "--model", str(drawn_model), *asked]) == 0
    warnings = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert "was trained for a single start" in warnings[0]
    assert "knows of no shift of its labels" in warnings[1]


def test_datasets_of_different_landmarks_are_not_mixed(
    drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for source in drawn.glob("face00[0-4].*"):
        (tmp_path / source.name).write_bytes(source.read_bytes())
    for path in tmp_path.glob("*.pts"):
        path.write_text("\n".join([*path.read_text().splitlines()[:-2], "}"]).replace("5\n{", "4\n{"))
    assert main(["evaluate", str(drawn_model), "--data", f"pts:{tmp_path}", "--out", str(tmp_path / "o")]) == 2
    assert "5 landmarks" in capsys.readouterr().err
    both = [f"pts:{drawn}", f"pts:{tmp_path}"]
    assert main(["train", "--data", *both, "--out", str(tmp_path / "m.safetensors")]) == 2
    assert "must share their landmarks" in capsys.readouterr().err


def test_too_few_people_are_said_before_the_work(
    drawn: Path, drawn_model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for command, work in (["train"], "train"), (["finetune", str(drawn_model)], "finetune"):
        monkeypatch.setattr(f"jaxfit.cli.{work}.{work}", None)
        out = str(drawn / "unwritten.safetensors")
        assert main([*command, "--data", f"pts:{drawn}", "--out", out, "--confidence", "999"]) == 2
        assert "from 2 to the number of subjects" in capsys.readouterr().err
