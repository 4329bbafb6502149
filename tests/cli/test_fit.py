"""``jaxfit fit`` over many pictures: killed and resumed, in every format, with every picture accounted for."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from test_commands import rows_of, write_boxes

import jaxfit
from jaxfit.cli.main import main
from jaxfit.data.boxes import bounding_square
from jaxfit.data.pictures import write_image
from jaxfit.data.pts import read_pts


@pytest.fixture
def many(drawn: Path, tmp_path: Path) -> Path:
    """Twelve pictures, the fourth and the ninth of which are none, and their boxes."""
    folder = tmp_path / "many"
    folder.mkdir()
    boxes = {}
    for number in range(12):
        source = drawn / f"face{number % 4:03}.png"
        picture = folder / f"{number:02}.png"
        picture.write_bytes(source.read_bytes() if number not in (3, 8) else b"no picture")
        boxes[picture.name] = bounding_square(read_pts(source.with_suffix(".pts")))
    write_boxes(tmp_path / "boxes.csv", boxes)
    return folder


@pytest.fixture
def command(many: Path, model: Path, tmp_path: Path) -> list[str]:
    out = str(tmp_path / "out")
    return ["fit", str(many), "--model", str(model), "--boxes", str(tmp_path / "boxes.csv"), "--out", out]


def test_all_pictures_are_accounted_for_in_every_format(command, many: Path, tmp_path: Path, capsys) -> None:
    pytest.importorskip("pyarrow")
    assert main([*command, "--format", "csv", "pts", "jsonl", "coco", "parquet", "--contact-sheet"]) == 0
    out = tmp_path / "out"
    rows, problems = rows_of(out / "landmarks.csv"), rows_of(out / "problems.csv")
    told = [Path(row["image"]).name for row in rows], [Path(row["image"]).name for row in problems]
    assert told[1] == ["03.png", "08.png"]
    assert sorted([*told[0], *told[1]]) == [f"{number:02}.png" for number in range(12)]
    assert not any(str(many) in row["problem"] for row in problems)
    assert len(json.loads((out / "keypoints.json").read_text())["annotations"]) == 10
    assert len((out / "faces.jsonl").read_text().splitlines()) == 10
    assert len(list((out / "pts").iterdir())) == len(list((out / "overlays").iterdir())) == 10
    assert jaxfit.read_image(out / "contact-sheet.jpg").std() > 10
    said = capsys.readouterr()
    assert "pictures: 12, faces fitted: 10" in said.out
    assert "2 problems" in said.err
    assert {path.name for path in out.iterdir()} == {
        *("landmarks.csv", "problems.csv", "faces.jsonl", "keypoints.json", "landmarks.parquet"),
        *("contact-sheet.jpg", "pts", "overlays"),
    }


def test_a_stopped_run_goes_on_where_it_was(command, tmp_path: Path, monkeypatch, capsys) -> None:
    from jaxfit.cli import fit

    monkeypatch.setattr(fit, "_CHUNK", 4)
    whole = [*command[:-1], str(tmp_path / "whole")]
    assert main(whole) == 0
    fitted, some = [], fit._fit_some

    def stops(work, pictures, labels):
        if len(fitted) == 2:
            raise KeyboardInterrupt
        fitted.append(len(pictures))
        return some(work, pictures, labels)

    monkeypatch.setattr(fit, "_fit_some", stops)
    with pytest.raises(KeyboardInterrupt):
        fit.run(_parsed(command))
    out = tmp_path / "out"
    assert not (out / "landmarks.csv").exists()
    # Of other pictures, or otherwise fitted, it must not go on.
    for changed in (["--box-kind", "square", "--no-overlays"], ["--initialisations", "3"]):
        assert main([*command, *changed]) == 2
        assert "--overwrite to begin anew" in capsys.readouterr().err
    monkeypatch.setattr(fit, "_fit_some", lambda *given: fitted.append(0) or some(*given))
    assert main(command) == 0
    assert fitted == [4, 4, 0]
    assert "going on: 8 of 12 pictures were fitted before" in capsys.readouterr().out
    for name in ("landmarks.csv", "problems.csv"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    # What is finished is done anew.
    assert main([*command, "--no-overlays"]) == 0
    assert len(fitted) == 6


def test_overwriting_an_unfinished_run(command, tmp_path: Path, monkeypatch) -> None:
    from jaxfit.cli import fit

    def fails(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fit, "_fit_some", fails)
        with pytest.raises(KeyboardInterrupt):
            fit.run(_parsed([*command, "--initialisations", "3"]))
    assert main(command) == 2
    assert main([*command, "--overwrite"]) == 0
    assert len(rows_of(tmp_path / "out" / "landmarks.csv")) == 10


def test_starts_that_cannot_be_are_refused_before_anything_is_written(command, tmp_path: Path, capsys) -> None:
    for wrong in (["--initialisations", "2"], ["--rotations", "10", "-10"]):
        assert main([*command, *wrong]) == 2
        assert "at least three" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def _parsed(command):
    from jaxfit.cli.main import parser

    return parser().parse_args(command)


@pytest.mark.skipif(os.name != "posix", reason="kills a process")
def test_a_killed_run_leaves_whole_chunks(command, tmp_path: Path) -> None:
    program = "import sys; from jaxfit.cli import fit, main; fit._CHUNK = 1; sys.exit(main.main(sys.argv[1:]))"
    process = subprocess.Popen([sys.executable, "-c", program, *command], stdout=subprocess.DEVNULL)
    unfinished = tmp_path / "out" / ".unfinished"
    until = time.monotonic() + 120
    while not list(unfinished.glob("*.jsonl")) and process.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    for path in unfinished.glob("[0-9]*.jsonl"):
        assert all(json.loads(line) for line in path.read_text().splitlines())
    assert subprocess.run([sys.executable, "-c", program, *command], stdout=subprocess.DEVNULL).returncode == 0
    out = tmp_path / "out"
    assert len(rows_of(out / "landmarks.csv")) + len(rows_of(out / "problems.csv")) == 12
    assert not unfinished.exists()


def test_folders_within_folders_patterns_and_videos(command, many: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    within = many / "within"
    within.mkdir()
    (within / "12.png").write_bytes((many / "00.png").read_bytes())
    (many / "13.jpg").mkdir()
    (many / ".hidden").mkdir()
    (many / ".hidden" / "14.png").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    counts = {
        (str(many),): 12,
        (str(many), "--recursive"): 13,
        ("many/0*.png",): 10,
        ("many/**/1*.png",): 3,
        ("many/within", "many/00.png", "many/00.png"): 2,
    }
    for pictures, count in counts.items():
        main(["fit", *pictures, *command[2:], "--no-overlays"])
        assert f"pictures: {count}, " in capsys.readouterr().out, pictures
    # What stands in the folder of results is left alone; a link to nothing is a problem, not nothing.
    (many / "lost.png").symlink_to(many / "nowhere.png")
    inside = ["fit", str(many), "--recursive", *command[2:-1], str(many / "results"), "--contact-sheet"]
    for _ in range(2):
        assert main(inside) == 0
        said = capsys.readouterr()
        assert "pictures: 14, " in said.out
        assert "lost.png" in said.err
    (many / "film.MP4").write_bytes(b"")
    assert main(["fit", "many/film.MP4", *command[2:]]) == 2
    assert "jaxfit track" in capsys.readouterr().err
    assert main(["fit", "many/*.tif", *command[2:]]) == 2
    assert "no such file or folder" in capsys.readouterr().err


def test_all_faces_of_a_picture_are_fitted(drawn: Path, model: Path, tmp_path: Path) -> None:
    one, other = (jaxfit.read_image(drawn / f"face{number:03}.png") for number in (0, 1))
    write_image(tmp_path / "both.png", np.hstack([one, other]))
    squares = [bounding_square(read_pts(drawn / f"face{number:03}.pts")) for number in (0, 1)]
    squares[1] = squares[1] + [one.shape[1], 0, 0, 0]
    rows = "".join(f"both.png,{','.join(map(str, square))}\n" for square in squares)
    (tmp_path / "boxes.csv").write_text(f"image,x,y,width,height\n{rows}")
    out = tmp_path / "out"
    fit = ["fit", str(tmp_path / "both.png"), "--model", str(model), "--boxes", str(tmp_path / "boxes.csv")]
    assert main([*fit, "--out", str(out), "--format", "csv", "coco"]) == 0
    rows = rows_of(out / "landmarks.csv")
    assert [row["face"] for row in rows] == ["both_1", "both_2"]
    apart = float(rows[1]["x1"]) - float(rows[0]["x1"])
    assert apart == pytest.approx(squares[1][0] - squares[0][0], abs=0.3 * squares[0][2])
    told = json.loads((out / "keypoints.json").read_text())
    assert len(told["images"]) == 1
    assert told["images"][0]["width"] == one.shape[1] + other.shape[1]


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text elsewhere")
def test_names_that_are_no_text(drawn: Path, model: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    folder = os.fsencode(tmp_path / "odd")
    os.mkdir(folder)
    source = drawn / "face000.png"
    for name in (b"\xe9t\xe9.png", b"\xff.png"):
        with open(os.path.join(folder, name), "wb") as file:
            file.write(source.read_bytes() if name != b"\xff.png" else b"")
    square = ",".join(map(str, bounding_square(read_pts(source.with_suffix(".pts")))))
    (tmp_path / "boxes.csv").write_bytes(
        b"image,x,y,width,height\n" + b"".join(b"%s,%s\n" % (n, square.encode()) for n in (b"a.png",))
    )
    out = tmp_path / "out"
    fit = ["fit", str(tmp_path / "odd"), "--model", str(model), "--out", str(out), "--format"]
    assert main([*fit, "csv", "jsonl", "coco", "parquet", "--boxes", str(tmp_path / "boxes.csv")]) == 1
    assert b"\xe9t\xe9.png" in (out / "problems.csv").read_bytes()
