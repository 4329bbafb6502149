"""Experiments on drawn heads: cells, what they share, resuming, and what comes out."""

import csv
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from drawn_heads import draw_heads
from filelock import FileLock

import jaxfit
from jaxfit.cascade.model import first_steps
from jaxfit.cli.main import keep_compiled_code, main
from jaxfit.data.pts import write_pts
from jaxfit.evaluating import evaluate
from jaxfit.exceptions import InputError
from jaxfit.experiments.cells import plan
from jaxfit.experiments.config import Config, config_from
from jaxfit.experiments.lab import Lab, load_arrays
from jaxfit.experiments.report import write_report
from jaxfit.experiments.results import Results, read_results
from jaxfit.experiments.running import run, standing
from jaxfit.experiments.thesis import THESIS

FACES = 24
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
    for steps in (1, 2):
        short = jaxfit.Model(first_steps(model.cascade, steps), model.scheme, model.placements, {}, model.head)
        again = evaluate(short, faces.chosen(rows), faces.boxes[rows])
        np.testing.assert_allclose(again.errors, dataset.grid["parametric"][steps - 1, 1, rows], rtol=1e-4)
        np.testing.assert_allclose(again.errors_3d, dataset.grid["alignment3d"][steps - 1, 1, rows], rtol=1e-4)
    assert (dataset.errors("parametric", config)[rows] == dataset.grid["parametric"][0, 1, rows]).all()
    assert (dataset.starts["parametric"][0] == dataset.grid["parametric"][0, 1]).all()


def test_a_training_that_serves_two_methods_is_that_of_each(results: Results, folder: Path) -> None:
    alone = config_from(tomllib.loads(PARAMETRIC_ALONE))
    run(alone, folder / "alone")
    (dataset,), (shared,) = read_results(folder / "alone").datasets, results.datasets
    np.testing.assert_array_equal(dataset.grid["parametric"], shared.grid["parametric"])
    np.testing.assert_array_equal(dataset.starts["parametric"], shared.starts["parametric"])


def test_killed_and_resumed_it_has_the_same_numbers(results: Results, folder: Path, config: Config) -> None:
    out = folder / "killed"
    command = [sys.executable, "-m", "jaxfit.cli.main", "experiments", "run", "config.toml", "--out", str(out)]
    source = str(Path(jaxfit.__file__).parents[1])
    cells = plan(config)
    with subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": source}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:  # until it is in the middle of the third cell
            if cells[2].name in line:
                time.sleep(0.2)
                process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    lab = Lab(config, out)
    assert [lab.result(cell.name).exists() for cell in cells].count(True) == 2
    begun = []
    run(config, out, begun=lambda cell, state: begun.append((cell.name, state.done)))
    assert begun == [(cell.name, done) for done, cell in enumerate(cells) if done >= 2]
    for cell in cells:
        one, other = load_arrays(lab.result(cell.name)), load_arrays(folder / "whole" / "cells" / f"{cell.name}.npz")
        assert one.keys() == other.keys()
        for name in one.keys() - {"seconds", "load"}:
            if not name.endswith(".seconds"):
                np.testing.assert_array_equal(one[name], other[name], err_msg=f"{cell.name} {name}")
    assert not list(out.rglob("*.tmp"))


def test_a_cell_that_another_process_runs_is_left_to_it(results: Results, config: Config, folder: Path) -> None:
    out = folder / "shared"
    lab = Lab(config, out)
    whole = Lab(config, folder / "whole")
    cells = plan(config)
    theirs = cells[0]
    for cell in cells[1:-1]:
        lab.save_result(cell.name, load_arrays(whole.result(cell.name)))
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


def test_results_of_another_configuration_are_not_mixed(results: Results, folder: Path) -> None:
    other = config_from(tomllib.loads(TEXT.replace("folds = 2", "folds = 3")))
    with pytest.raises(InputError, match="holds results of other settings \\(folds\\)"):
        run(other, folder / "whole")


def test_a_damaged_result_is_told(results: Results, config: Config, folder: Path) -> None:
    lab = Lab(config, folder / "damaged")
    for cell in plan(config):
        lab.save_result(cell.name, load_arrays(folder / "whole" / "cells" / f"{cell.name}.npz"))
    torn = lab.result(plan(config)[1].name)
    torn.write_bytes(torn.read_bytes()[:200])
    with pytest.raises(InputError, match=r"fold1\.npz: is damaged .* delete it"):
        standing(lab)


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


def test_reports_of_what_is_not_finished_leave_out_what_is_missing(
    results: Results, config: Config, folder: Path
) -> None:
    lab, cells = Lab(config, folder / "part"), plan(config)
    run_only = cells[:2]
    (folder / "part").mkdir()
    for file in ("config.json", "datasets/drawn.npz"):
        (folder / "part" / file).parent.mkdir(exist_ok=True)
        (folder / "part" / file).write_bytes((folder / "whole" / file).read_bytes())
    for cell in run_only:
        lab.save_result(cell.name, load_arrays(folder / "whole" / "cells" / f"{cell.name}.npz"))
    (folder / "part-report").mkdir()
    assert write_report(folder / "part", folder / "part-report", pictures=False) == len(cells) - 2
    page = (folder / "part-report" / "report.html").read_text()
    assert "Figure 12" in page
    for not_run in ("Tables 4, 6", "Appendices D, E"):
        assert not_run not in page
    assert "/9j/" not in page  # how JPEG files begin, in base64
