"""Experiments on drawn heads: cells, what they share, resuming, and what comes out."""

import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from drawn_heads import draw_heads
from filelock import FileLock

import jaxfit
from jaxfit.cascade.model import first_steps
from jaxfit.cli.main import main
from jaxfit.compile_cache import keep_compiled_code
from jaxfit.data.pts import write_pts
from jaxfit.errors import ImageError, InputError
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.experiments.cells import Cell, Grid, Times, plan
from jaxfit.experiments.config import Config, config_from
from jaxfit.experiments.document import Document, Gallery
from jaxfit.experiments.lab import Lab, load_arrays, save_arrays
from jaxfit.experiments.report import document
from jaxfit.experiments.results import Results, read_results
from jaxfit.experiments.running import keep_settings, run, standing
from jaxfit.experiments.thesis import THESIS
from jaxfit.labels.datasets import FORMATS
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.learning.train import Trained
from jaxfit.schemes.known import AFLW21, IBUG68
from jaxfit.schemes.scheme import Scheme

FACES = 14  # in two folds: fewer than 8, of which batches are made, lest these be compiled too
# Two steps, and starts far from upright: enough to tell apart what must be.
TEXT = """
folds = 2
augmentations = [1, 2]
initialisations = [1, 3]
repetitions = 2
timed_faces = 4
[chosen]
augmentations = 2
steps = 1
[training]
windows = [0.6, 0.4]
shape_variance = 0.9
mirror = false
frame = {crop = 64, face = 36}
[datasets.drawn]
data = ["pts:drawn"]
thesis = "AFLW"
[methods.parametric]
[methods.alignment3d]
"""
PARAMETRIC_ALONE = TEXT.replace("[methods.alignment3d]\n", "")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with labelled pictures, in which commands are run."""
    folder = tmp_path_factory.mktemp("experiment")
    (folder / "drawn").mkdir()
    for face in draw_heads(folder / "drawn", FACES):
        write_pts(face.image.with_suffix(".pts"), face.landmarks)
    (folder / "config.toml").write_text(TEXT)
    (folder / "alone.toml").write_text(PARAMETRIC_ALONE)
    return folder


@pytest.fixture(autouse=True, scope="module")
def _own_code() -> None:
    """What other tests have compiled, with all optimisations, gives other last digits than a new process."""
    jax.clear_caches()


@pytest.fixture(autouse=True)
def _there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(folder)
    # Compiling takes most of the time: less well, and sooner; in other processes too.
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    jax.config.update("jax_disable_most_optimizations", True)
    keep_compiled_code()
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def config() -> Config:
    return config_from(tomllib.loads(TEXT))


@pytest.fixture
def results(config: Config, folder: Path) -> Results:
    run(config, folder / "whole")  # does nothing the second time
    return read_results(folder / "whole")


def test_every_face_has_an_error_of_every_cell(results: Results) -> None:
    assert results.missing == 0
    (dataset,) = results.datasets
    for name, grid in dataset.grid.items():
        assert grid.shape == (2, 2, FACES)
        assert np.isfinite(grid).all()
        assert np.isfinite(dataset.fits[name]).all()
        assert (dataset.seconds[name] > 0).all()
        assert len(dataset.seconds[name]) == 2
    subjects = dataset.faces["subject"]
    for fold in (0, 1):
        assert set(subjects[dataset.faces["fold"] == fold]).isdisjoint(subjects[dataset.faces["fold"] != fold])


def test_rows_of_the_grid_are_what_shorter_cascades_find(results: Results, config: Config, folder: Path) -> None:
    (dataset,) = results.datasets
    lab = Lab(config, folder / "whole")
    faces = lab.faces["drawn"]
    rows = faces.tested(0)
    model = lab.load_model("grid/drawn/parametric+alignment3d/a2/fold0")
    short = jaxfit.Model(first_steps(model.cascade, 1), model.scheme, model.placements, {}, model.aligned)
    again = evaluate(short, faces.chosen(rows), faces.boxes[rows])
    np.testing.assert_allclose(again.errors, dataset.grid["parametric"][0, 1, rows], rtol=1e-4)
    np.testing.assert_allclose(again.errors_3d, dataset.grid["alignment3d"][0, 1, rows], rtol=1e-4)
    assert (dataset.errors("parametric", config)[rows] == dataset.grid["parametric"][0, 1, rows]).all()
    assert (dataset.starts["parametric"][0] == dataset.grid["parametric"][0, 1]).all()


def test_killed_resumed_and_without_a_method_it_has_the_same_numbers(results: Results, folder: Path) -> None:
    """One training serves both methods: that of the parametric method alone is the same."""
    out = folder / "killed"
    command = [sys.executable, "-m", "jaxfit.cli.main", "experiments", "run", "alone.toml", "--out", str(out)]
    source = str(Path(jaxfit.__file__).parents[1])
    alone = config_from(tomllib.loads(PARAMETRIC_ALONE))
    cells = plan(alone)
    with subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": source}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:  # until it is in the middle of the third cell
            if cells[2].name in line:
                time.sleep(0.2)
                process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert [Lab(alone, out).result(cell.name).exists() for cell in cells].count(True) == 2
    begun = []
    run(alone, out, begun=lambda cell, state: begun.append((cell.name, state.done)))
    assert begun == [(cell.name, done) for done, cell in enumerate(cells) if done >= 2]
    resumed = read_results(out)
    assert resumed.missing == 0
    (dataset,), (whole,) = resumed.datasets, results.datasets
    for name in ("grid", "starts", "fits"):
        np.testing.assert_array_equal(getattr(dataset, name)["parametric"], getattr(whole, name)["parametric"])
    assert dataset.faces.keys() == whole.faces.keys()
    for name in dataset.faces:
        np.testing.assert_array_equal(dataset.faces[name], whole.faces[name])


def test_a_cell_that_another_process_runs_is_left_to_it(results: Results, config: Config, folder: Path) -> None:
    out = folder / "shared"
    cells = plan(config)
    theirs = cells[0]
    lab, whole = copied(folder, "shared", config, cells[1:-1]), Lab(config, folder / "whole")
    lock = FileLock(out / "locks" / f"{theirs.name.replace('/', '-')}.lock")
    (out / "locks").mkdir()
    lock.acquire()
    begun = []

    def they_finish(cell, state) -> None:
        begun.append(cell.name)
        lab.save_result(theirs.name, load_arrays(whole.result(theirs.name)))
        lock.release()

    run(config, out, begun=they_finish)
    assert begun == [cells[-1].name]


def copied(folder: Path, name: str, config: Config, cells: Sequence[Cell]) -> Lab:
    """A folder with the results of some cells."""
    lab, whole = Lab(config, folder / name), Lab(config, folder / "whole")
    for cell in cells:
        lab.save_result(cell.name, load_arrays(whole.result(cell.name)))
    for file in ("config.json", "datasets/drawn.npz"):
        (lab.folder / file).parent.mkdir(exist_ok=True)
        shutil.copy(whole.folder / file, lab.folder / file)
    return lab


def test_a_cell_that_fails_is_told_when_the_others_are_done(
    results: Results, config: Config, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = plan(config)
    needed, needing, last = cells[0], cells[2], cells[-1]
    assert needing.needs == (needed.name,)
    lab = copied(folder, "failing", config, [cell for cell in cells if cell not in (needed, needing, last)])
    kept = load_arrays(Lab(config, folder / "whole").result(last.name))
    ran = []

    def fail_first(cell: Grid, lab: Lab, progress: Callable) -> dict:
        ran.append(cell)
        if cell == needed:
            raise InputError("no luck")
        return kept

    monkeypatch.setattr(Grid, "run", fail_first)
    with pytest.raises(InputError, match=f"{re.escape(needed.name)}: no luck$"):
        run(config, lab.folder)
    assert ran == [needed, last]
    assert lab.result(last.name).exists()
    assert not lab.result(needing.name).exists()


def test_what_cannot_be_read_is_not_timed(results: Results, config: Config, folder: Path) -> None:
    lab = Lab(config, folder / "whole")
    first = lab.faces["drawn"].records[lab.faces["drawn"].tested(0)[0]].image
    asked, read = [], lab.pictures

    def pictures(path: Path) -> np.ndarray:
        asked.append(path)
        if path == first:
            raise ImageError(f"{path}: torn")
        return read(path)

    lab.pictures = pictures  # type: ignore[assignment]
    (times,) = (cell for cell in plan(config) if isinstance(cell, Times))
    arrays = times.run(lab, lambda stage, done, total: None)
    assert arrays["faces"] == config.timed_faces == len(asked) - 1
    assert (arrays["parametric.seconds"] > 0).all()


def test_other_faces_are_not_mixed_and_pictures_may_move(results: Results, config: Config, folder: Path) -> None:
    lab = copied(folder, "moved", config, [])
    faces = lab.faces["drawn"]
    moved = tuple(replace(face, image=Path("elsewhere") / face.image.name) for face in faces.records)
    lab.faces["drawn"] = replace(faces, records=moved)
    keep_settings(lab)
    lab.write_faces()
    before, after = (load_arrays(path / "datasets" / "drawn.npz") for path in (folder / "whole", lab.folder))
    assert [Path(image).parent.name for image in after["image"]] == ["elsewhere"] * FACES
    np.testing.assert_array_equal(after["landmarks"], before["landmarks"])
    assert [section.title for section in document(read_results(lab.folder)).sections] == ["Nothing to show"]
    relabelled = tuple(replace(face, landmarks=face.landmarks + 1) for face in moved)
    lab.faces["drawn"] = replace(faces, records=relabelled)
    with pytest.raises(InputError, match=r"of other settings \(labels.drawn: "):
        keep_settings(lab)


def test_methods_are_not_compared_before_all_folds_are_run(results: Results, config: Config, folder: Path) -> None:
    cells = plan(config)
    lab = copied(folder, "folds", config, [cells[0], *cells[-2:]])
    partial = read_results(lab.folder)
    (dataset,), (whole,) = partial.datasets, results.datasets
    assert (partial.missing, partial.waiting) == (len(cells) - 3, 1)
    assert np.isnan(dataset.errors("parametric", config)).all()
    np.testing.assert_array_equal(dataset.grid["parametric"][:, 0], whole.grid["parametric"][:, 0])
    assert document(partial).about["left out"] == "1 cells, until those of all folds are run"


def test_pose_is_tested(results: Results, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = Lab(results.config, folder / "whole").load_model("grid/drawn/parametric+alignment3d/a2/fold0")

    def already_trained(faces: Sequence[FaceRecord], scheme: Scheme, **options) -> Trained:
        assert scheme == AFLW21
        return Trained(model, len(faces), ())

    monkeypatch.setattr("jaxfit.experiments.cells.train", already_trained)
    heads = Dataset("heads:drawn", AFLW21, draw_heads(folder / "drawn", FACES)[: FACES // 2])
    monkeypatch.setitem(FORMATS, "heads", lambda path: heads)
    text = TEXT.split("[datasets.drawn]")[0] + "[methods.solid]\nmethod = 'alignment3d'\n"
    config = config_from(tomllib.loads(text + "[pose]\ntrain = ['heads:drawn']\ntest = ['heads:drawn']"))
    run(config, folder / "pose")
    tested = read_results(folder / "pose")
    (pose,) = tested.pose
    np.testing.assert_array_equal(pose.truth, [face.pose for face in heads.faces])
    assert list(pose.subjects) == [face.subject for face in heads.faces]
    assert np.corrcoef(pose.fitted["solid"][:, 2], pose.truth[:, 2])[0, 1] > 0.6
    parts = {part.name for section in document(tested).sections for part in section.parts}
    assert parts == {"pose-heads", "surface-heads-solid", "pose-heads-solid-pitch", "pose-heads-solid-yaw"}
    # Other landmarks than those that are trained on are told before anything is.
    monkeypatch.setitem(FORMATS, "pts", lambda path: replace(heads, scheme=IBUG68))
    other = config_from(tomllib.loads(text + "[pose]\ntrain = ['heads:drawn']\ntest = ['pts:drawn']"))
    with pytest.raises(
        InputError, match="test faces of aflw21, as in train, or without landmarks; pts:drawn has ibug68"
    ):
        run(other, folder / "other-pose")


def test_results_of_another_configuration_are_not_mixed(results: Results, folder: Path) -> None:
    other = config_from(tomllib.loads(TEXT.replace("folds = 2", "folds = 3")))
    with pytest.raises(InputError, match=r"holds results of other settings \(folds: 2 there, 3 here; labels.drawn: "):
        run(other, folder / "whole")


def test_a_damaged_result_is_told(results: Results, config: Config, folder: Path) -> None:
    lab = copied(folder, "damaged", config, plan(config))
    torn = lab.result(plan(config)[1].name)
    torn.write_bytes(torn.read_bytes()[:200])
    with pytest.raises(InputError, match=r"fold1\.npz: is damaged .* delete it"):
        standing(lab)
    (lab.folder / "datasets" / "drawn.npz").unlink()
    torn.unlink()
    with pytest.raises(InputError, match=r"drawn\.npz: is missing; run the experiment again"):
        read_results(lab.folder)


def test_a_dry_run_tells_and_does_nothing(results: Results, folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["experiments", "run", "config.toml", "--out", "new", "--dry-run"]) == 0
    told = capsys.readouterr().out
    assert f"drawn: {FACES} faces with all 21 landmarks (aflw21)" in told
    assert "7 of 7 cells to run" in told
    assert not (folder / "new").exists()
    assert main(["experiments", "run", "config.toml", "--out", "whole", "--dry-run"]) == 0
    assert "0 of 7 cells to run; one process takes about 0 s, by the pace so far" in capsys.readouterr().out


def test_reports(results: Results, config: Config, folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["experiments", "report", "whole", "--out", "report"]) == 0
    report = folder / "report"
    page = (report / "report.html").read_text()
    assert "Figure 12. drawn: errors over steps and augmentations" in page
    assert "/9j/" in page
    (dataset,) = results.datasets
    with open(report / "tables" / "grid-drawn-parametric.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[1]["1"]) == pytest.approx(dataset.grid["parametric"][1, 0].mean())
    thesis = THESIS["grid"]["AFLW"]["parametric"]["mean"][1][0]
    assert float(rows[1]["1 ratio"]) == pytest.approx(dataset.grid["parametric"][1, 0].mean() / thesis)
    with open(report / "tables" / "errors-3d.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    errors = dataset.errors("alignment3d", config)
    assert float(row["mean"]) == pytest.approx(errors.mean())
    assert float(row["AUC from"]) <= float(row["AUC@0.08"]) <= float(row["AUC to"])
    assert main(["experiments", "report", "drawn"]) == 2
    assert "expected results of jaxfit experiments run" in capsys.readouterr().err
    assert not (folder / "drawn" / "report").exists()


def test_reports_of_what_is_not_finished_leave_out_what_is_missing(
    results: Results, config: Config, folder: Path
) -> None:
    lab = copied(folder, "part", config, plan(config)[:2])
    partial = document(read_results(lab.folder), pictures=False)
    parts = {part.name: part for section in partial.sections for part in section.parts if not isinstance(part, Gallery)}
    assert parts.keys() == {
        *("grid-drawn-2d", "best-2d", "grid-drawn-3d", "best-3d", "ced-drawn-2d", "errors-2d", "ced-drawn-3d"),
        *("errors-3d", "fits-drawn-2d", "fits-drawn-3d", "grid-drawn-parametric", "grid-drawn-alignment3d"),
        "starts-drawn",
    }
    assert "the 2D fit is drawn" in parts["fits-drawn-3d"].note
    assert not parts["fits-drawn-2d"].note
    for ax in parts["fits-drawn-2d"].figure.axes:  # whole faces are seen, without pictures too
        labels = np.concatenate([line.get_xydata() for line in ax.lines if line.get_color() == "red"])
        assert (labels > [ax.get_xlim()[0], ax.get_ylim()[1]]).all()
        assert (labels < [ax.get_xlim()[1], ax.get_ylim()[0]]).all()
    gallery = gallery_of(partial)
    assert not any(face.jpeg for face in gallery.faces)
    assert "are no longer where they were" not in gallery.note
    faces = load_arrays(folder / "whole" / "datasets" / "drawn.npz")
    save_arrays(lab.folder / "datasets" / "drawn.npz", {**faces, "image": np.array(["gone.png"] * FACES)})
    assert f"{FACES} pictures are no longer where they were" in gallery_of(document(read_results(lab.folder))).note


def gallery_of(report: Document) -> Gallery:
    (gallery,) = (part for section in report.sections for part in section.parts if isinstance(part, Gallery))
    return gallery
