"""Batches in workers of several kinds, and collections: every picture once, whichever process is killed."""

import fcntl
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, replace
from importlib.util import find_spec
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxfit.data.detectors.whole import Whole
from jaxfit.data.locks import held
from jaxfit.errors import InputError, JaxfitError, ModelError
from jaxfit.fitting import Fitting
from jaxfit.fitting.pipeline import require_fitting
from jaxfit.runs import BatchFitter, FolderRun, collection, fit_collection, fit_folder

Columns = dict[str, np.ndarray]

_MODEL = "fast68"
_BROKEN = 3  # the number of the picture that is none


@pytest.fixture(scope="module")
def many(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten pictures, one of which is none."""
    folder = tmp_path_factory.mktemp("many")
    for number in range(10):
        data = (drawn / f"face{number:03}.png").read_bytes()
        (folder / f"{number:02}.png").write_bytes(data if number != _BROKEN else b"no picture")
    return folder


@pytest.fixture(scope="module")
def fitter() -> BatchFitter:
    return BatchFitter(_MODEL, Fitting("whole"))


@pytest.fixture(scope="module")
def batch(many: Path) -> Columns:
    return {"image": np.array(sorted(map(str, many.iterdir())), object)}


@pytest.fixture(scope="module")
def rows(fitter: BatchFitter, batch: Columns) -> Columns:
    return fitter(batch)


def same(some: Columns, others: Columns) -> bool:
    """Whether two batches of rows are equal but for rounding: faces computed in other company end in other bits."""
    return list(some) == list(others) and all(
        np.allclose(values, others[name], atol=0.0011, equal_nan=True)
        if values.dtype == np.float32
        else list(values) == list(others[name])
        for name, values in some.items()
    )


def test_a_batch_says_what_a_folder_run_says(rows: Columns, batch: Columns, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    run = FolderRun(tmp_path, _MODEL, fitting=Fitting("whole"), formats=("parquet",), overlays=False)
    report = fit_folder(run, list(batch["image"]))
    table = parquet.read_table(tmp_path / "landmarks.parquet")
    fitted = rows["problem"] == ""
    assert [*table.column_names, "problem"] == list(rows)
    expected = {
        name: np.array(table[name].to_pylist(), rows[name].dtype) for name in table.column_names
    }  # float32 and objects
    assert same({name: rows[name][fitted] for name in expected}, expected)
    assert report.problems == ((rows["image"][_BROKEN], rows["problem"][_BROKEN]),)
    assert list(np.flatnonzero(~fitted)) == [_BROKEN]


def test_bytes_are_as_good_as_files(fitter: BatchFitter, batch: Columns, rows: Columns) -> None:
    data = [Path(path).read_bytes() for path in batch["image"]]
    of_bytes = fitter({"path": list(batch["image"]), "bytes": data})
    assert same(of_bytes, rows)
    assert fitter({"image": ["a"], "bytes": [None]})["problem"].tolist() == ["the file is empty"]


def test_a_fitter_is_small_and_loads_its_model_in_processes_of_a_pool(
    fitter: BatchFitter, batch: Columns, rows: Columns
) -> None:
    assert len(pickle.dumps(fitter)) < 500
    parts = [{"image": batch["image"][first : first + 5]} for first in (0, 5)]
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        fitted = list(pool.map(fitter, parts))
    assert same({name: np.concatenate([part[name] for part in fitted]) for name in rows}, rows)


def test_data_frames_are_batches(fitter: BatchFitter, batch: Columns, rows: Columns) -> None:
    """As Spark's mapInPandas has them, and Dask's map_partitions."""
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(batch)
    whole = pandas.DataFrame(fitter(frame))
    assert same({name: whole[name].to_numpy() for name in whole}, rows)
    nothing = pandas.DataFrame(fitter({"image": []}))
    assert list(nothing) == list(whole)
    assert not len(nothing)
    assert nothing.dtypes["ok"].kind == "b"
    assert (nothing.dtypes.drop("ok").iloc[3:-1] == np.float32).all()


def test_dask_maps_it_over_partitions(fitter: BatchFitter, batch: Columns, rows: Columns) -> None:
    dask, pandas = pytest.importorskip("dask.dataframe"), pytest.importorskip("pandas")

    def fit(frame: Any) -> Any:
        return pandas.DataFrame(fitter(frame))

    nothing = fit(pandas.DataFrame({"image": []}))
    frames = dask.from_pandas(pandas.DataFrame(batch), npartitions=2)
    whole = frames.map_partitions(fit, meta=nothing).compute(scheduler="synchronous")
    assert same({name: whole[name].to_numpy() for name in whole}, rows)


def test_heads_have_columns_of_their_own() -> None:
    columns = list(BatchFitter("regression68-3d", Fitting("whole"))({"image": []}))
    assert columns[-1] == "problem"
    assert {"x1", "head_roll", "head_scale", "head_x1", "head_z68", "head_b1"} <= {*columns}


def test_a_collection_goes_on_only_with_the_same_settings(fitter: BatchFitter) -> None:
    others: dict[str, Any] = {
        "model": "face68",
        "fitting": Fitting("haar"),
        "refine": True,
        "max_megapixels": 3.0,
        "unshift": True,
        "heads": True,
    }
    assert {*others, "cores"} == {field.name for field in fields(BatchFitter)}
    for name, value in others.items():
        assert collection._settings(replace(fitter, **{name: value})) != collection._settings(fitter), name
    assert collection._settings(replace(fitter, cores=2)) == collection._settings(fitter)


def test_nonsense_is_refused_before_any_work(fitter: BatchFitter, tmp_path: Path) -> None:
    settings: tuple[dict[str, Any], ...] = (
        {"fitting": Fitting("nose")},
        {"fitting": Fitting(Whole())},
        {"cores": 0},
    )
    for wrong in settings:
        with pytest.raises(InputError, match="expected"):
            BatchFitter(**wrong)
    with pytest.raises(InputError, match=r"expected jaxfit.Fitting\(detector=...\).*got 'whole'"):
        require_fitting("whole")
    with pytest.raises(ModelError, match="no model 'face69'"):
        BatchFitter("face69")
    with pytest.raises(InputError, match="image or path; got bytes"):
        fitter({"bytes": [b""]})
    picture = np.zeros((4, 4, 3), np.uint8)
    for batch, words in (
        ({"image": [picture]}, "names of files in the column image; got numpy.ndarray"),
        ({"image": ["a.jpg"], "bytes": [picture]}, "in the column bytes; got numpy.ndarray"),
        ({"image": ["a.jpg"], "bytes": [5]}, "got int"),
    ):
        with pytest.raises(InputError, match=words):
            fitter(batch)
    numbers: tuple[dict[str, Any], ...] = ({"part": 0}, {"workers": 0}, {"gpus": -1.0})
    for wrong in numbers:
        with pytest.raises(InputError, match="expected at least"):
            fit_collection([], tmp_path, fitter, **wrong)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Collections are fitted here, without Ray; gathers the parts that are fitted."""
    pytest.importorskip("pyarrow")
    begun: list[list[str]] = []

    def fit_parts(
        parts: Sequence[Sequence[str]], fitter: BatchFitter, folder: Path, workers: int | None, gpus: float
    ) -> Generator[tuple[int, str], None, None]:
        work = collection._PartFitter(fitter, folder)
        for part in parts:
            begun.append([Path(name).name for name in part])
            done = work({"pictures": list(map(os.fsencode, part))})
            yield done["pictures"], done["error"]

    monkeypatch.setattr(collection, "_require_ray", lambda: None)
    monkeypatch.setattr(collection, "_fit_parts", fit_parts)
    return begun


def manifest(out: Path) -> list[dict[str, Any]]:
    parquet = pytest.importorskip("pyarrow.parquet")
    rows: list[dict[str, Any]] = parquet.read_table(out / "manifest.parquet").to_pylist()
    return rows


def test_only_what_is_missing_is_fitted(
    in_process: list[list[str]], fitter: BatchFitter, batch: Columns, tmp_path: Path
) -> None:
    pictures = list(batch["image"])
    calls: list[tuple[int, int]] = []
    fit_collection(pictures[:4], tmp_path, fitter, part=2)
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "parts").iterdir()}
    assert len(written) == 2
    in_process.clear()
    outcomes = fit_collection(pictures, tmp_path, fitter, part=4, progress=lambda _, *call: calls.append(call))
    assert in_process == [[f"{number:02}.png" for number in some] for some in (range(4, 8), range(8, 10))]
    assert calls == [(4, 10), (8, 10), (10, 10)]
    assert outcomes == {"fitted": 9, "none": 0, "problem": 1, "missing": 0}
    assert written == {path: path.stat().st_mtime_ns for path in written}
    found = manifest(tmp_path)
    assert [row["image"] for row in found] == pictures
    assert [row["outcome"] for row in found] == ["fitted"] * _BROKEN + ["problem"] + ["fitted"] * 6
    assert [row["faces"] for row in found] == [int(number != _BROKEN) for number in range(10)]
    assert {row["part"] for row in found} == {path.name for path in (tmp_path / "parts").iterdir()}


def test_pictures_that_have_changed_are_fitted_anew(
    in_process: list[list[str]], fitter: BatchFitter, batch: Columns, tmp_path: Path
) -> None:
    pictures = [tmp_path / f"{number}.png" for number in range(4)]
    for picture in pictures:
        picture.write_bytes(Path(batch["image"][0]).read_bytes())
    fit_collection(pictures, tmp_path / "out", fitter, part=2)
    for changed, outcomes in ((pictures[1:2], (3, 1)), (pictures[2:], (1, 3))):
        in_process.clear()
        for picture in changed:
            picture.write_bytes(b"no picture any more")
        counts = fit_collection(pictures, tmp_path / "out", fitter, part=2)
        assert in_process == [[picture.name for picture in changed]]
        assert (counts["fitted"], counts["problem"]) == outcomes
        assert len(manifest(tmp_path / "out")) == 4
    in_process.clear()
    fit_collection(pictures, tmp_path / "out", fitter, part=2)
    assert not in_process
    with held(tmp_path / "out", "jaxfit collect"), pytest.raises(InputError, match="is being written by"):
        fit_collection(pictures, tmp_path / "out", fitter, part=2)


def test_a_part_that_kills_its_workers_is_missing_and_tried_again_later(
    in_process: list[list[str]], fitter: BatchFitter, batch: Columns, tmp_path: Path
) -> None:
    pictures = list(batch["image"][:4])
    fit_collection(pictures[:2], tmp_path, fitter, part=2)
    work = collection._PartFitter(fitter, tmp_path / "parts")
    deadly = {"pictures": list(map(os.fsencode, pictures[2:]))}

    def dies(*_: object) -> None:
        raise SystemExit

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collection, "_write_part", dies)
        for _ in range(3):
            with pytest.raises(SystemExit):
                work(deadly)
        assert work(deadly) == {"pictures": 0, "error": ""}
        patch.setattr(collection, "_fit_parts", lambda *_: (made for made in [(0, "")]))
        outcomes = fit_collection(pictures, tmp_path, fitter, part=2)
    assert outcomes == {"fitted": 2, "none": 0, "problem": 0, "missing": 2}
    assert [row["outcome"] for row in manifest(tmp_path)] == ["fitted", "fitted", "missing", "missing"]
    outcomes = fit_collection(pictures, tmp_path, fitter, part=2)
    assert outcomes == {"fitted": 3, "none": 0, "problem": 1, "missing": 0}


def test_what_stops_a_worker_stops_the_run(
    in_process: list[list[str]], fitter: BatchFitter, batch: Columns, tmp_path: Path
) -> None:
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"no model")
    with pytest.raises(JaxfitError, match="damaged"):
        fit_collection(list(batch["image"]), tmp_path / "out", BatchFitter(damaged, Fitting("whole")))
    with pytest.raises(InputError, match="other settings"):
        fit_collection(list(batch["image"]), tmp_path / "out", fitter)


def test_ray_has_to_be_there_and_to_keep_to_this_machine(
    fitter: BatchFitter, batch: Columns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collection, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install"):
        fit_collection(list(batch["image"]), tmp_path, fitter)
    monkeypatch.setattr(collection, "find_spec", lambda name: True)
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(is_initialized=lambda: False))
    monkeypatch.delenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", raising=False)
    with pytest.raises(InputError, match="imported, but not started"):
        fit_collection(list(batch["image"]), tmp_path, fitter)
    assert not list(tmp_path.iterdir())


_IN_A_CLUSTER = """
import os, sys
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
import ray, ray.data
from jaxfit import Fitting
from jaxfit.runs import BatchFitter, fit_collection
model, out, *pictures = sys.argv[1:]
ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
print(fit_collection(pictures, out, BatchFitter(model, Fitting("whole")), workers=1, part=2), flush=True)
rows = ray.data.read_binary_files(sorted(pictures)[:2], include_paths=True).map_batches(
    BatchFitter,
    fn_constructor_kwargs={"model": model, "fitting": Fitting("whole")},
    batch_size=2,
    compute=ray.data.ActorPoolStrategy(size=1),
).take_all()
print(sorted((os.path.basename(row["image"]), row["problem"]) for row in rows))
"""


class _Hold:
    """Holds whoever opens a file, by a lease of Linux, for up to 45 seconds."""

    def __init__(self, path: Path):
        self._asked = Event()
        self._before = signal.signal(signal.SIGIO, lambda *_: self._asked.set())
        self._file = os.open(path, os.O_WRONLY)
        fcntl.fcntl(self._file, fcntl.F_SETLEASE, fcntl.F_WRLCK)

    def wait(self, run: "subprocess.Popen[str]") -> None:
        """Until a worker wants to open it."""
        while not self._asked.wait(0.1):
            assert run.poll() is None, run.communicate()

    def release(self) -> None:
        """Let everybody open it."""
        os.close(self._file)
        signal.signal(signal.SIGIO, self._before)


@pytest.mark.timeout(600)
@pytest.mark.skipif(not find_spec("ray"), reason="needs jaxfit[ray]")
def test_with_ray_every_picture_comes_once_whoever_is_killed(batch: Columns, tmp_path: Path) -> None:
    """A picture that cannot be opened yet holds its worker until that, or the whole run, is killed."""
    psutil = pytest.importorskip("psutil")
    out, late = tmp_path / "out", tmp_path / "late.png"
    late.write_bytes(Path(batch["image"][0]).read_bytes())

    def map_workers(run: "subprocess.Popen[str]") -> list[Any]:
        family = psutil.Process(run.pid).children(recursive=True)
        return [each for each in family if "MapWorker" in " ".join(each.cmdline())]

    pictures = [*batch["image"][:4], str(late), *batch["image"][4:]]
    environment = {**os.environ, "RAY_worker_niceness": "0"}
    collect = [sys.executable, "-m", "jaxfit.cli.main", "collect", "--model", _MODEL, "--detector", "whole"]
    collect += ["--out", str(out), "--workers", "1", "--part", "2", *pictures]

    hold = _Hold(late)
    with subprocess.Popen(collect, env=environment, text=True) as run:
        hold.wait(run)
        workers = map_workers(run)
        family = psutil.Process(run.pid).children(recursive=True)
        sockets = [socket for each in family for socket in each.net_connections() if socket.status == "LISTEN"]
        assert {socket.laddr.ip.removeprefix("::ffff:") for socket in sockets} == {"127.0.0.1"}
        run.kill()
    psutil.wait_procs(workers)
    hold.release()
    written = {path: path.stat().st_mtime_ns for path in (out / "parts").glob("[!.]*.parquet")}
    assert len(written) == 2

    command = [sys.executable, "-c", _IN_A_CLUSTER, _MODEL, str(out), *pictures]
    hold = _Hold(late)
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as run:
        hold.wait(run)
        (worker,) = map_workers(run)
        worker.send_signal(signal.SIGKILL)
        hold.release()
        said = run.communicate()[0].splitlines()
    assert said[-2:] == [  # after what Ray says of the worker
        "{'fitted': 10, 'none': 0, 'problem': 1, 'missing': 0}",
        "[('00.png', ''), ('01.png', '')]",
    ]
    assert written == {path: path.stat().st_mtime_ns for path in written}
    assert sorted(row["image"] for row in manifest(out)) == sorted(pictures)
    table = pytest.importorskip("pyarrow.parquet").read_table(out / "parts")
    assert sorted(table["image"].to_pylist()) == sorted(pictures)
    assert not list((out / "parts").glob(".*"))
