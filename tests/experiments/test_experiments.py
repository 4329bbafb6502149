"""Experiments on drawn heads: tasks, what they share, resuming, and results."""

import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from drawn_heads import draw_heads
from filelock import FileLock
from report_words import check_is_the_same_without_the_thesis

import jaxfit
from jaxfit.cascade.model import first_steps
from jaxfit.cli.main import main
from jaxfit.data.pts import write_pts
from jaxfit.errors import ImageError, InputError
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.experiments.arrays import Arrays, load_arrays, save_arrays
from jaxfit.experiments.config import Config, config_from
from jaxfit.experiments.experiment import Experiment
from jaxfit.experiments.report import build_report
from jaxfit.experiments.report_parts import Gallery, Report, ReportFigure
from jaxfit.experiments.results import ExperimentResults, read_results
from jaxfit.experiments.runner import Status, experiment_status, run_experiment
from jaxfit.experiments.tasks import GridTask, Task, TimesTask, plan_tasks
from jaxfit.experiments.thesis.numbers import THESIS
from jaxfit.labels.datasets import FORMATS
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.learning.train import Trained
from jaxfit.schemes.known import AFLW21, IBUG68
from jaxfit.schemes.scheme import Scheme
from jaxfit.types import Progress

FACES = 14  # in two folds: each has fewer than 8 faces, so that one size of batch is compiled
# Two steps, and starts far from upright, so that results that must differ do. All components of the features are kept:
# models of both folds have one size, and are compiled once.
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
variance = 1.0
[datasets.drawn]
data = ["pts:drawn"]
thesis = "AFLW"
[methods.parametric]
[methods.alignment3d]
"""
# One method of the two, and the chosen augmentations alone.
PARAMETRIC_ALONE = TEXT.replace("[methods.alignment3d]\n", "").replace("augmentations = [1, 2]", "augmentations = [2]")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with labelled pictures, in which commands are run."""
    folder = tmp_path_factory.mktemp("experiment")
    (folder / "drawn").mkdir()
    for face in draw_heads(folder / "drawn", FACES):
        write_pts(face.image.with_suffix(".pts"), face.landmarks)
    (folder / "config.toml").write_text(TEXT)
    return folder


@pytest.fixture(autouse=True, scope="module")
def _there(folder: Path) -> Iterator[None]:
    """In the folder."""
    jax.clear_caches()  # code that other tests have compiled gives other last digits than a new process
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield


@pytest.fixture(scope="module")
def config() -> Config:
    return config_from(tomllib.loads(TEXT))


class Killed(NamedTuple):
    """What another process left that was killed while it ran the experiment."""

    returncode: int
    done: list[bool]


@pytest.fixture(scope="module")
def killed(config: Config, folder: Path, _there: None) -> Killed:
    """The experiment is begun by a process that is killed in the middle of the second task."""
    command = [sys.executable, "-m", "jaxfit.cli.main", "experiments", "run", "config.toml", "--out", "whole"]
    source = str(Path(jaxfit.__file__).parents[1])
    tasks = plan_tasks(config)
    with subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": source}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if tasks[1].name in line:
                time.sleep(0.2)
                process.send_signal(signal.SIGKILL)
    experiment = Experiment(config, folder / "whole")
    return Killed(process.returncode, [experiment.done(task.name) for task in tasks])


@pytest.fixture(scope="module")
def begun() -> list[tuple[str, int]]:
    """The tasks that were begun after that, and how many were done then."""
    return []


@pytest.fixture(scope="module")
def results(config: Config, folder: Path, killed: Killed, begun: list[tuple[str, int]]) -> ExperimentResults:
    """The results of the whole experiment, which goes on where it was killed."""
    run_experiment(config, folder / "whole", begun=lambda task, status: begun.append((task.name, status.done)))
    return read_results(folder / "whole")


def test_every_face_has_an_error_of_every_task(results: ExperimentResults) -> None:
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


def test_rows_of_the_grid_are_what_shorter_cascades_find(
    results: ExperimentResults, config: Config, folder: Path
) -> None:
    (dataset,) = results.datasets
    experiment = Experiment(config, folder / "whole")
    faces = experiment.faces["drawn"]
    rows = faces.tested(0)
    model = experiment.load_model("grid/drawn/parametric+alignment3d/a2/fold0")
    short = replace(model, cascade=first_steps(model.cascade, 1))
    again = evaluate(short, faces.chosen(rows), faces.boxes[rows])
    assert again.errors_3d is not None
    np.testing.assert_allclose(again.errors, dataset.grid["parametric"][0, 1, rows], rtol=1e-4)
    np.testing.assert_allclose(again.errors_3d, dataset.grid["alignment3d"][0, 1, rows], rtol=1e-4)
    assert (dataset.errors("parametric", config)[rows] == dataset.grid["parametric"][0, 1, rows]).all()
    assert (dataset.starts["parametric"][0] == dataset.grid["parametric"][0, 1]).all()


def test_a_killed_run_goes_on_where_it_was(
    results: ExperimentResults, config: Config, killed: Killed, begun: list[tuple[str, int]]
) -> None:
    tasks = plan_tasks(config)
    assert killed.returncode == -signal.SIGKILL
    assert killed.done == [True] + [False] * (len(tasks) - 1)
    assert begun == [(task.name, done) for done, task in enumerate(tasks) if done >= 1]
    assert results.missing == 0


def test_killed_or_not_and_with_another_method_or_not_it_has_the_same_numbers(
    results: ExperimentResults, folder: Path
) -> None:
    """One training serves both methods: that of the parametric method alone is the same."""
    run_experiment(config_from(tomllib.loads(PARAMETRIC_ALONE)), folder / "alone")
    alone = read_results(folder / "alone")
    assert alone.missing == 0
    (dataset,), (whole,) = alone.datasets, results.datasets
    np.testing.assert_array_equal(dataset.grid["parametric"][:, 0], whole.grid["parametric"][:, 1])
    for name in ("starts", "fits"):
        np.testing.assert_array_equal(getattr(dataset, name)["parametric"], getattr(whole, name)["parametric"])
    assert dataset.faces.keys() == whole.faces.keys()
    for name in dataset.faces:
        np.testing.assert_array_equal(dataset.faces[name], whole.faces[name])


def test_a_task_that_another_process_runs_is_left_to_it(
    results: ExperimentResults, config: Config, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks = plan_tasks(config)
    theirs, ours = tasks[0], tasks[-1]
    experiment, whole = copied(folder, "shared", config, tasks[1:-1]), Experiment(config, folder / "whole")
    lock = FileLock(experiment.folder / "locks" / f"{theirs.name.replace('/', '-')}.lock")
    (experiment.folder / "locks").mkdir()
    lock.acquire()
    begun = []

    def they_finish(task: Task, status: Status) -> None:
        begun.append(task.name)
        experiment.save_result(theirs.name, load_arrays(whole.result(theirs.name)))
        lock.release()

    kept = load_arrays(whole.result(ours.name))
    monkeypatch.setattr(GridTask, "run", lambda task, experiment, progress: kept)
    run_experiment(config, experiment.folder, begun=they_finish)
    assert begun == [ours.name]
    assert experiment.done(ours.name)


def copied(folder: Path, name: str, config: Config, tasks: Sequence[Task]) -> Experiment:
    """An experiment in a folder with the results of some tasks."""
    experiment, whole = Experiment(config, folder / name), Experiment(config, folder / "whole")
    for task in tasks:
        experiment.save_result(task.name, load_arrays(whole.result(task.name)))
    for file in ("config.json", "datasets/drawn.npz"):
        (experiment.folder / file).parent.mkdir(exist_ok=True)
        shutil.copy(whole.folder / file, experiment.folder / file)
    return experiment


def test_a_task_that_fails_is_reported_when_the_others_are_done(
    results: ExperimentResults, config: Config, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks = plan_tasks(config)
    needed, needing, last = tasks[0], tasks[2], tasks[-1]
    assert needing.needs == (needed.name,)
    experiment = copied(folder, "failing", config, [task for task in tasks if task not in (needed, needing, last)])
    kept = load_arrays(Experiment(config, folder / "whole").result(last.name))
    ran = []

    def fail_first(task: GridTask, experiment: Experiment, progress: Progress) -> Arrays:
        ran.append(task)
        if task == needed:
            raise InputError("no luck")
        return kept

    monkeypatch.setattr(GridTask, "run", fail_first)
    with pytest.raises(InputError, match=f"{re.escape(needed.name)}: no luck$"):
        run_experiment(config, experiment.folder)
    assert ran == [needed, last]
    assert experiment.result(last.name).exists()
    assert not experiment.result(needing.name).exists()


def test_what_cannot_be_read_is_not_timed(results: ExperimentResults, config: Config, folder: Path) -> None:
    experiment = Experiment(config, folder / "whole")
    first = experiment.faces["drawn"].records[experiment.faces["drawn"].tested(0)[0]].image
    asked, read = [], experiment.pictures

    def pictures(path: Path) -> np.ndarray:
        asked.append(path)
        if path == first:
            raise ImageError(f"{path}: torn")
        return read(path)

    experiment.pictures = pictures  # type: ignore[assignment]
    (times,) = (task for task in plan_tasks(config) if isinstance(task, TimesTask))
    arrays = times.run(experiment, lambda stage, done, total: None)
    assert arrays["faces"] == config.timed_faces == len(asked) - 1
    assert (arrays["parametric.seconds"] > 0).all()


def test_other_faces_are_not_mixed_and_pictures_may_move(
    results: ExperimentResults, config: Config, folder: Path
) -> None:
    experiment = copied(folder, "moved", config, [])
    faces = experiment.faces["drawn"]
    moved = tuple(replace(face, image=Path("elsewhere") / face.image.name) for face in faces.records)
    experiment.faces["drawn"] = replace(faces, records=moved)
    experiment.keep_settings()
    experiment.write_faces()
    before, after = (load_arrays(path / "datasets" / "drawn.npz") for path in (folder / "whole", experiment.folder))
    assert [Path(image).parent.name for image in after["image"]] == ["elsewhere"] * FACES
    np.testing.assert_array_equal(after["landmarks"], before["landmarks"])
    assert [section.title for section in build_report(read_results(experiment.folder)).sections] == ["Nothing to show"]
    relabelled = tuple(replace(face, landmarks=face.landmarks + 1) for face in moved)
    experiment.faces["drawn"] = replace(faces, records=relabelled)
    with pytest.raises(InputError, match=r"of other settings \(labels.drawn: "):
        experiment.keep_settings()


def test_methods_are_not_compared_before_all_folds_are_run(
    results: ExperimentResults, config: Config, folder: Path
) -> None:
    tasks = plan_tasks(config)
    experiment = copied(folder, "folds", config, [tasks[0], *tasks[-2:]])
    partial = read_results(experiment.folder)
    (dataset,), (whole,) = partial.datasets, results.datasets
    assert (partial.missing, partial.waiting) == (len(tasks) - 3, 1)
    assert np.isnan(dataset.errors("parametric", config)).all()
    np.testing.assert_array_equal(dataset.grid["parametric"][:, 0], whole.grid["parametric"][:, 0])
    assert build_report(partial).about["left out"] == "1 tasks, until those of all folds are run"


def test_pose_is_tested(results: ExperimentResults, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = Experiment(results.config, folder / "whole").load_model("grid/drawn/parametric+alignment3d/a2/fold0")

    def already_trained(faces: Sequence[FaceRecord], scheme: Scheme, **options: Any) -> Trained:
        assert scheme == AFLW21
        return Trained(model, len(faces), ())

    monkeypatch.setattr("jaxfit.experiments.tasks.train", already_trained)
    heads = Dataset("heads:drawn", AFLW21, draw_heads(folder / "drawn", FACES)[: FACES // 2])
    monkeypatch.setitem(FORMATS, "heads", lambda path: heads)
    text = TEXT.split("[datasets.drawn]")[0] + "[methods.solid]\nmethod = 'alignment3d'\n"
    config = config_from(tomllib.loads(text + "[pose]\ntrain = ['heads:drawn']\ntest = ['heads:drawn']"))
    run_experiment(config, folder / "pose")
    tested = read_results(folder / "pose")
    (pose,) = tested.pose
    np.testing.assert_array_equal(pose.truth, [face.pose for face in heads.faces])
    assert list(pose.subjects) == [face.subject for face in heads.faces]
    assert np.corrcoef(pose.fitted["solid"][:, 2], pose.truth[:, 2])[0, 1] > 0.6
    parts = {part.name for section in build_report(tested).sections for part in section.parts}
    assert parts == {"pose-heads", "surface-heads-solid", "pose-heads-solid-pitch", "pose-heads-solid-yaw"}
    # Other landmarks than those that are trained on are refused before anything is run.
    monkeypatch.setitem(FORMATS, "pts", lambda path: replace(heads, scheme=IBUG68))
    other = config_from(tomllib.loads(text + "[pose]\ntrain = ['heads:drawn']\ntest = ['pts:drawn']"))
    with pytest.raises(
        InputError, match="test faces of aflw21, as in train, or without landmarks; pts:drawn has ibug68"
    ):
        run_experiment(other, folder / "other-pose")


def test_results_of_another_configuration_are_not_mixed(results: ExperimentResults, folder: Path) -> None:
    other = config_from(tomllib.loads(TEXT.replace("folds = 2", "folds = 3")))
    with pytest.raises(InputError, match=r"holds results of other settings \(folds: 2 there, 3 here; labels.drawn: "):
        run_experiment(other, folder / "whole")


def test_a_damaged_result_is_reported(results: ExperimentResults, config: Config, folder: Path) -> None:
    experiment = copied(folder, "damaged", config, plan_tasks(config))
    torn = experiment.result(plan_tasks(config)[1].name)
    torn.write_bytes(torn.read_bytes()[:200])
    with pytest.raises(InputError, match=r"fold1\.npz: is damaged .* delete it"):
        experiment_status(experiment)
    (experiment.folder / "datasets" / "drawn.npz").unlink()
    torn.unlink()
    with pytest.raises(InputError, match=r"drawn\.npz: is missing; run the experiment again"):
        read_results(experiment.folder)


def test_a_dry_run_says_what_there_is_to_do_and_does_nothing(
    results: ExperimentResults, folder: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["experiments", "run", "config.toml", "--out", "new", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert f"drawn: {FACES} faces with all 21 landmarks (aflw21)" in said
    assert "7 of 7 tasks to run" in said
    assert not (folder / "new").exists()
    assert main(["experiments", "run", "config.toml", "--out", "whole", "--dry-run"]) == 0
    assert "0 of 7 tasks to run; one process takes about 0 s, by the pace so far" in capsys.readouterr().out


def test_reports(results: ExperimentResults, config: Config, folder: Path, capsys: pytest.CaptureFixture) -> None:
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
    results: ExperimentResults, config: Config, folder: Path
) -> None:
    experiment = copied(folder, "part", config, plan_tasks(config)[:2])
    partial = build_report(read_results(experiment.folder), pictures=False)
    parts = {part.name: part for section in partial.sections for part in section.parts if not isinstance(part, Gallery)}
    assert parts.keys() == {
        *("grid-drawn-2d", "best-2d", "grid-drawn-3d", "best-3d", "ced-drawn-2d", "errors-2d", "ced-drawn-3d"),
        *("errors-3d", "fits-drawn-2d", "fits-drawn-3d", "grid-drawn-parametric", "grid-drawn-alignment3d"),
        "starts-drawn",
    }
    assert "the 2D fit is drawn" in parts["fits-drawn-3d"].note
    assert not parts["fits-drawn-2d"].note
    fits = parts["fits-drawn-2d"]
    assert isinstance(fits, ReportFigure)
    for ax in fits.figure.axes:  # whole faces are shown, without pictures too
        labels = np.concatenate([line.get_xydata() for line in ax.lines if line.get_color() == "red"])
        assert (labels > [ax.get_xlim()[0], ax.get_ylim()[1]]).all()
        assert (labels < [ax.get_xlim()[1], ax.get_ylim()[0]]).all()
    gallery = gallery_of(partial)
    assert not any(face.jpeg for face in gallery.faces)
    assert "are no longer where they were" not in gallery.note
    faces = load_arrays(folder / "whole" / "datasets" / "drawn.npz")
    save_arrays(experiment.folder / "datasets" / "drawn.npz", {**faces, "image": np.array(["gone.png"] * FACES)})
    note = gallery_of(build_report(read_results(experiment.folder))).note
    assert f"{FACES} pictures are no longer where they were" in note


def test_a_report_without_the_thesis_has_the_same_numbers(results: ExperimentResults, config: Config) -> None:
    plain = replace(config, datasets=tuple(replace(plan, thesis=None) for plan in config.datasets))
    datasets = tuple(replace(dataset, thesis=None) for dataset in results.datasets)
    report = build_report(results, pictures=False)
    without = build_report(replace(results, config=plain, datasets=datasets), pictures=False)
    check_is_the_same_without_the_thesis(report, without)


def gallery_of(report: Report) -> Gallery:
    (gallery,) = (part for section in report.sections for part in section.parts if isinstance(part, Gallery))
    return gallery
