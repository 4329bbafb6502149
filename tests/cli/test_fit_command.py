"""``jaxfit fit``: how its options are understood, and what it prints. What it writes is tested in ``tests/runs``."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from csv_files import labelled_box, read_csv, write_boxes

from jaxfit.cascade.starts import Starts
from jaxfit.cli.main import main
from jaxfit.data.cameras import FieldOfView, PinholeCamera
from jaxfit.fitting import Fitting, Placing
from jaxfit.runs import FolderReport, FolderRun
from jaxfit.runs.folder import Unfit


def test_one_run_from_the_options_to_the_results(
    drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyarrow")
    pictures = tmp_path / "pictures"
    (pictures / "within").mkdir(parents=True)
    good = (drawn / "face000.png").read_bytes()
    for name, data in (("a.png", good), ("b.png", b"no picture"), ("within/c.png", good), ("d.png", good)):
        (pictures / name).write_bytes(data)
    square = labelled_box(drawn / "face000.png")
    boxes = write_boxes(tmp_path / "boxes.csv", dict.fromkeys(("a.png", "b.png", "c.png", "elsewhere.png"), square))
    out = tmp_path / "out"
    fit = ["fit", str(pictures), "--recursive", "--model", str(drawn_model), "--boxes", str(boxes), "--out", str(out)]
    assert main([*fit, "--format", "csv", "parquet", "--contact-sheet", "--starts", "3"]) == 0
    assert [Path(row["image"]).name for row in read_csv(out / "landmarks.csv")] == ["a.png", "c.png"]
    names = ["landmarks.csv", "landmarks.parquet", "contact-sheet.jpg", "problems.csv", "overlays", "manifest.json"]
    assert {path.name for path in out.iterdir()} == {*names}
    printed = capsys.readouterr()
    assert f"pictures: 4, faces fitted: 2, model: {drawn_model}\n" in printed.out
    assert f"written: {', '.join(str(out / name) for name in names)}\n" in printed.out
    assert "going on" not in printed.out
    before, _, problems = printed.err.partition("3 problems:\n")
    assert re.match("warning: .* was trained for a single start", before)  # said before the work
    assert "fitting" in before
    lines = problems.splitlines()
    assert f"{pictures / 'b.png'}: not a picture" in lines[0]
    assert f"{pictures / 'd.png'}: no row with this file name in the boxes" in lines[1]
    assert f"{boxes}: rows for pictures that were not given: 1, such as elsewhere.png" in lines[2]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[FolderRun, list[Path]]]:
    """Nothing is fitted; what would be is gathered."""
    calls: list[tuple[FolderRun, list[Path]]] = []

    def fit_folder(
        run: FolderRun, pictures: Sequence[Path], *, progress: Callable[[str, int, int], None]
    ) -> FolderReport:
        calls.append((run, list(pictures)))
        why = (Unfit("a.png", "the file is empty"),)
        return FolderReport(12, 8, 0, 0, why, (), (), (Path("out") / "problems.csv",), 0, "")

    monkeypatch.setattr("jaxfit.cli.fit.fit_folder", fit_folder)
    return calls


def test_options_make_a_run(asked: list[tuple[FolderRun, list[Path]]], drawn: Path) -> None:
    fit = ["fit", str(drawn), "--model", "fast68", "--out", "out"]
    main(fit)
    main([*fit, "--detector", "whole", "--no-overlays", "--contact-sheet", "--overwrite", "--format", "coco", "csv"])
    main([*fit, "--boxes", "b.csv", "--box-kind", "dlib", "--refine", "--starts", "5", "--rotations", "-30", "40"])
    main([*fit, "--heads", "--camera", "900", "950", "320", "240.5"])
    main([*fit, "--field-of-view", "60", "--pupil-distance", "58.5"])
    usual = FolderRun("out", "fast68", folders=(str(drawn),))
    assert [run for run, _ in asked] == [
        usual,
        replace(
            usual,
            fitting=Fitting("whole"),
            formats=("coco", "csv"),
            overlays=False,
            contact_sheet=True,
            overwrite=True,
        ),
        replace(usual, boxes="b.csv", box_kind="dlib", fitting=Fitting(starts=Starts(5, -30.0, 40.0)), refine=True),
        replace(usual, heads=True, placing=Placing(PinholeCamera(900.0, 950.0, 320.0, 240.5))),
        replace(usual, placing=Placing(FieldOfView(60.0), 58.5)),
    ]


def test_what_is_printed_of_a_run_that_goes_on_and_finds_no_face(
    asked: list[tuple[FolderRun, list[Path]]], drawn: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", str(drawn), "--model", "fast68", "--out", "out"]) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [
        "going on: 8 of 12 pictures were fitted before",
        "pictures: 12, faces fitted: 0, model: fast68",
        f"written: {Path('out') / 'problems.csv'}",
    ]
    assert printed.err.splitlines() == ["1 problem:", "  a.png: the file is empty"]


def test_folders_within_folders_patterns_and_videos(
    asked: list[tuple[FolderRun, list[Path]]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in (*(f"many/{number:02}.png" for number in range(12)), "many/within/12.png", "many/.hidden/14.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    (tmp_path / "many" / "13.jpg").mkdir()
    (tmp_path / "many" / "lost.png").symlink_to(tmp_path / "nowhere.png")
    monkeypatch.chdir(tmp_path)
    rest = ["--model", "fast68", "--out", "out"]
    counts = {
        ("many",): 13,
        ("many", "--recursive"): 14,
        ("many/0*.png",): 10,
        ("many/**/1*.png",): 3,
        ("many/within", "many/00.png", "many/00.png"): 2,
    }
    for pictures, count in counts.items():
        assert main(["fit", *pictures, *rest]) == 1
        assert len(asked[-1][1]) == count, pictures
    (tmp_path / "many" / "film.MP4").write_bytes(b"")
    assert main(["fit", "many/film.MP4", *rest]) == 2
    assert "jaxfit track" in capsys.readouterr().err
    assert main(["fit", "many/*.tif", *rest]) == 2
    assert "no such file or folder" in capsys.readouterr().err
    assert len(asked) == len(counts)


def test_wrong_settings_are_refused_before_anything_is_written(
    drawn: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for words, wrong in {
        r"expected one start or at least three (of two fits none is nearer to the others); got 2": ["--starts", "2"],
        "the lowest first": ["--rotations", "10", "-10"],
        "only models of the method alignment3d": ["--refine", "--detector", "whole"],
        "give that file too": ["--box-kind", "whole"],
        "min confidence: expected a number from 0 to 1": ["--min-confidence", "7"],
        "expected --camera or --field-of-view; got both": ["--camera", "9", "9", "1", "1", "--field-of-view", "60"],
        "expected --camera or --field-of-view with it; got neither": ["--pupil-distance", "60"],
        "focal lengths, above 0": ["--camera", "0", "9", "1", "1"],
        "any rotation); got both": ["--boxes", "boxes.csv", "--any-rotation"],
    }.items():
        assert main(["fit", str(drawn), "--model", str(drawn_model), "--out", str(out), *wrong]) == 2
        printed = capsys.readouterr()
        assert words in printed.err
        assert printed.out == ""
    assert not out.exists()
