"""The script of cross-validation on drawn faces: a fold, and the tables of two methods side by side."""

import csv
import runpy
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from drawing import TRAIN, draw_faces

from jaxfit.evaluation.statistics import rank_sum, signed_rank
from jaxfit.learning.methods import Options

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "crossvalidate.py"
METHODS = ["sdm", "sdm:ridge=9,spread=1.2"]


class StandIns:
    """For training and evaluation, to have two methods on two folds in no time: what they get, and errors drawn."""

    def __init__(self) -> None:
        self.trained: list[tuple[list[str], str, Options]] = []
        self.boxes: list[np.ndarray] = []

    def train(self, faces, scheme, *, method, options, progress):
        self.trained.append(([face.face for face in faces], method, options))
        return SimpleNamespace(model=SimpleNamespace(method=method, options=options), problems=())

    def evaluate(self, model, faces, boxes, *, normaliser, initialisations, rotations, progress):
        assert (initialisations, rotations) == (model.options.initialisations, model.options.rotations)
        self.boxes.append(boxes)
        errors = np.random.default_rng(len(faces)).uniform(0.02, 0.1, len(faces)) * model.options.ridge**0.1
        errors[:2] = np.inf, np.nan
        errors_3d = 1.5 * errors if model.method.endswith("3d") else None
        return SimpleNamespace(errors=errors, errors_3d=errors_3d, problems={})


def crossvalidate(*arguments: str, stand_ins: StandIns | None = None) -> int:
    main = runpy.run_path(str(SCRIPT))["main"]
    if stand_ins:
        main.__globals__.update(train=stand_ins.train, evaluate=stand_ins.evaluate)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(SCRIPT), *arguments])
        return main()


def table_rows(text: str, words: str) -> list[list[str]]:
    return [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith(f"| {words}")]


def errors(paths: list[Path], column: str = "nmed") -> dict[tuple[str, str], float]:
    rows = [row for path in paths for row in csv.DictReader(path.read_text().splitlines())]
    return {(row["dataset"], row["face"]): float(row[column]) for row in rows}


def test_a_fold_is_trained_and_measured(tmp_path: Path) -> None:
    # Three folds of 32 faces are as many as `model` learns from, and need no other compilation.
    drawn, out = draw_faces(tmp_path / "drawn", 32), tmp_path / "out"
    command = ["--data", f"pts:{drawn}", "--out", str(out), *TRAIN, "--no-haar", "--normaliser", "box"]
    assert crossvalidate(*command, "--folds", "4", "--fold", "1") == 0
    assert {path.name for path in out.iterdir()} == {"settings.json", "fold1-sdm.csv"}
    measured = errors([out / "fold1-sdm.csv"])
    assert len(measured) == 8
    assert np.median(list(measured.values())) < 0.05


def test_two_methods_side_by_side(drawn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [tmp_path / "first", tmp_path / "second"]
    pictures = sorted(drawn.glob("*.png"))
    for folder, part in zip(folders, (pictures[:13], pictures[13:]), strict=True):
        folder.mkdir()
        for picture in part:
            shutil.copy(picture, folder)
            shutil.copy(picture.with_suffix(".pts"), folder)
    out = tmp_path / "out"
    command = ["--data", *(f"pts:{folder}" for folder in folders), "--out", str(out), "--folds", "2"]

    stand_ins = StandIns()
    assert crossvalidate(*command, "--method", "sdm", "--fold", "1", stand_ins=stand_ins) == 0
    assert [path.name for path in out.glob("fold*")] == ["fold1-sdm.csv"]
    assert crossvalidate(*command, "--method", *METHODS, stand_ins=stand_ins) == 0
    # The finished fold was kept; in each fold both methods had the same faces, and boxes to start from.
    learned = [(method, options.ridge, options.spread) for _, method, options in stand_ins.trained]
    assert learned == [("sdm", 1.0, 1.0), ("sdm", 1.0, 1.0), ("sdm", 9.0, 1.2), ("sdm", 9.0, 1.2)]
    assert stand_ins.trained[1][0] == stand_ins.trained[2][0] != stand_ins.trained[0][0] == stand_ins.trained[3][0]
    np.testing.assert_array_equal(stand_ins.boxes[1], stand_ins.boxes[2])
    np.testing.assert_array_equal(stand_ins.boxes[0], stand_ins.boxes[3])

    table = (out / "table.md").read_text()
    assert capsys.readouterr().out.endswith(table)
    of_first, of_other = (
        errors([out / f"fold{fold}-{name}.csv" for fold in (0, 1)]) for name in ("sdm", "sdm-ridge=9,spread=1.2")
    )
    assert of_first.keys() == of_other.keys()
    assert len(of_first) == 24
    assert [row[:3] for row in table_rows(table, "first")[:2]] == [["first", name, "13"] for name in METHODS]
    compared = table.partition("Compared with sdm")[2]
    for name in ("first", "second", "all"):
        faces = [face for face in of_first if name in ("all", face[0]) and not np.isnan(of_first[face])]
        a, b = np.array([of_first[face] for face in faces]), np.array([of_other[face] for face in faces])
        difference = f"{np.median(b) / np.median(a) - 1:+.1%}"
        numbers = [str(len(faces)), difference, f"{rank_sum(b, a):.2g}", f"{signed_rank(b, a):.2g}"]
        assert table_rows(compared, name) == [[name, METHODS[1], *numbers]]

    # One method alone needs no comparison, and other settings another folder.
    assert crossvalidate(*command) == 0
    assert "Compared" not in (out / "table.md").read_text()
    assert crossvalidate(*command, "--ridge", "5") == 2
    assert "other settings (ridge: " in capsys.readouterr().err


def test_3d_methods_have_a_table_of_errors_in_3d(drawn: Path, tmp_path: Path) -> None:
    methods = ["sdm", "alignment3d", "regression3d"]
    command = ["--data", f"pts:{drawn}", "--out", str(tmp_path), "--folds", "2"]
    assert crossvalidate(*command, "--method", *methods, stand_ins=StandIns()) == 0
    with pytest.raises(KeyError):
        errors([tmp_path / "fold0-sdm.csv"], "nmed_3d")
    flat, solid = (
        errors([tmp_path / f"fold{n}-regression3d.csv" for n in (0, 1)], name) for name in ("nmed", "nmed_3d")
    )
    np.testing.assert_allclose(list(solid.values()), 1.5 * np.array(list(flat.values())))
    in_2d, _, in_3d = (tmp_path / "table.md").read_text().partition("In 3D, against labels")
    name = drawn.name
    assert [row[1] for row in table_rows(in_2d, name)] == [*methods, *methods[1:]]
    rows = [row for row in table_rows(in_3d, name) if row[2] == "24"]
    assert [row[1] for row in rows] == methods[1:]
    assert f"{np.nanmedian(list(solid.values())):.4f}" in rows[1]


def test_wrong_methods_stop_before_the_work(drawn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    for methods, words in ((["sdm", "sdm"], "each method once"), (["sdm:nothing=1"], "got 'nothing'")):
        assert crossvalidate("--data", f"pts:{drawn}", "--out", str(out), "--method", *methods) == 2
        assert words in capsys.readouterr().err
    assert not out.exists()
