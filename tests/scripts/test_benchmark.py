"""The benchmark on drawn heads: every number is there and can be one, whatever its size."""

import csv
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_heads import draw_heads
from script_runner import load, run

import jaxfit
from jaxfit.cascade.model import Cascade
from jaxfit.cascade.starts import Spread
from jaxfit.data.pts import write_pts
from jaxfit.descriptors.dense import Dense
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.errors import nmed
from jaxfit.image.frame import Frame
from jaxfit.labels.records import Dataset
from jaxfit.models.placements import Placement
from jaxfit.schemes.known import AFLW21
from jaxfit.shapes.points import PointSpace

BATCHES = [1, 4]
STEPS = 2
FRAME = Frame(crop=64, face=36.0)

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes are kept to cores on Linux")


@pytest.fixture(scope="module")
def script() -> Any:
    return load("benchmark")


@pytest.fixture(scope="module")
def rival() -> Any:
    """The part that needs dlib, with few trees."""
    pytest.importorskip("dlib", exc_type=ImportError, reason='dlib is not installed: pip install "jaxfit[bench]"')
    module = load("benchmark_dlib")
    module.TREES = 20
    return module


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Dataset]:
    """Faces to train on, and others to measure with, labelled in files."""
    faces = draw_heads(tmp_path_factory.mktemp("all"), 24)
    parts = {}
    for name, of_part in {"train": faces[:16], "test": faces[16:]}.items():
        folder = tmp_path_factory.mktemp(name, numbered=False)
        for face in of_part:
            os.link(face.image, folder / face.image.name)
            write_pts(folder / f"{face.face}.pts", face.landmarks)
        parts[name] = jaxfit.read_dataset(f"pts:{folder}")
    return parts


@pytest.fixture(scope="module")
def model(parts: dict[str, Dataset], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two steps that no training has made: they move the mean face about a little."""
    faces = np.stack([face.landmarks for face in parts["train"].faces])
    mean = (faces - faces.mean(1, keepdims=True)).mean(0)
    space = PointSpace(jnp.asarray(mean * FRAME.face / np.ptp(mean, 0).max(), jnp.float32))
    descriptor = Dense()  # which is compiled soonest
    shape = (STEPS, AFLW21.count * descriptor.size, space.size)
    cascade = Cascade(
        space=space,
        weights=tuple(jnp.asarray(np.random.default_rng(0).normal(0, 0.1, shape), jnp.float32)),
        biases=jnp.zeros((STEPS, space.size)),
        windows=jnp.asarray([0.6, 0.3]) * FRAME.face,
        descriptor=descriptor,
        frame=FRAME,
    )
    placement = Placement((0.0, 0.0), 0.0, Spread((0.05, 0.05), 0.05, 0.05))
    path = tmp_path_factory.mktemp("model") / "heads.safetensors"
    jaxfit.save(jaxfit.Model(cascade, AFLW21, {"square": placement}), path)
    return path


@pytest.fixture(scope="module")
def predictor(rival: Any, model: Path, parts: dict[str, Dataset], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dlib") / "heads.dat"
    rival.train_rival(path, jaxfit.load(model), parts["train"].faces, AFLW21)
    return path


@pytest.fixture(scope="module")
def benchmark(
    script: Any,
    model: Path,
    parts: dict[str, Dataset],
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """The folder that a run has written to; with dlib, where it is installed."""
    folder = tmp_path_factory.mktemp("out")
    arguments = ["--data", parts["test"].spec, "--cores", "1", "--repetitions", "1", "--out", str(folder)]
    arguments += ["--batches", *map(str, BATCHES)]
    if script.dlib is not None:
        arguments += ["--dlib-model", str(request.getfixturevalue("predictor"))]
    assert run("benchmark", str(model), *arguments) == 0
    return folder


def tables(folder: Path) -> list[list[dict[str, str]]]:
    """Every table of a run: its rows, by column."""
    found = []
    for block in (folder / "benchmark.md").read_text(encoding="utf-8").split("\n\n"):
        if block.startswith("|"):
            lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.strip().splitlines()]
            found.append([dict(zip(lines[0], line, strict=True)) for line in lines[2:]])
    return found


def is_positive(cell: str) -> bool:
    number = float(cell.rstrip("%"))
    return math.isfinite(number) and number > 0


def test_a_run_measures_speed_memory_and_size(benchmark: Path, model: Path) -> None:
    speeds, by_batch, *_ = tables(benchmark)
    (row,) = [row for row in speeds if row["method"] == "heads"]
    assert (row["processes"], row["cores"]) == ("1", "1")
    assert int(row["at batch"]) in BATCHES
    numbers = {"faces/s", "from files/s", "latency ms", "first s", "compile s", "peak MiB", "model MB"}
    assert all(is_positive(row[name]) for name in numbers)
    assert float(row["model MB"]) == round(model.stat().st_size / 1e6, 1)
    assert [int(row["batch"]) for row in by_batch] == BATCHES
    assert all(is_positive(row["heads, 1 core"]) for row in by_batch)
    with open(benchmark / "benchmark.csv", encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["method"] == "heads"]
    assert [int(row["batch"]) for row in rows] == BATCHES
    assert all(is_positive(row[name]) for row in rows for name in [*numbers, "load s"])
    assert float(rows[0]["peak MiB"]) <= float(rows[1]["peak MiB"])
    with open(benchmark / "sizes.csv", encoding="utf-8", newline="") as file:
        sizes = [row for row in csv.DictReader(file) if row["method"] == "heads"]
    assert [int(row["count"]) for row in sizes if row["size"] == "steps"] == list(range(1, STEPS + 1))
    assert [int(row["count"]) for row in sizes if row["size"] == "landmarks"][-1] == AFLW21.count
    assert all(is_positive(row["faces/s"]) for row in sizes)
    assert (benchmark / "throughput.png").read_bytes().startswith(b"\x89PNG")
    text = (benchmark / "benchmark.md").read_text(encoding="utf-8")
    assert f"jaxfit {jaxfit.__version__}, jax {jax.__version__}" in text


def test_a_run_measures_errors_as_evaluation_does(benchmark: Path, model: Path, parts: dict[str, Dataset]) -> None:
    (row,) = [row for row in tables(benchmark)[2] if row["method"] == "heads"]
    faces = parts["test"].faces
    errors = jaxfit.evaluate(jaxfit.load(model), faces, start_boxes(faces)).errors
    assert (row["dataset"], row["faces"], row["no fit"]) == ("test", str(len(faces)), "0")
    assert float(row["median"]) == pytest.approx(np.median(errors), abs=1e-4)


def test_a_run_measures_stages_beside_the_machine(benchmark: Path) -> None:
    product, memory, *stages = tables(benchmark)[-1]
    assert is_positive(product["GFLOP/s"])
    assert is_positive(memory["GB/s"])
    assert [row["stage"] for row in stages] == ["maps", "describing", "linear map", "moving", "the fit"]
    assert [row["times a fit"] for row in stages] == ["1", *[str(STEPS)] * 3, "1"]
    assert all(row["model"] == "heads" and is_positive(row["µs a face"]) for row in stages)
    assert [row["stage"] for row in stages if row["GFLOP/s"] != "-"] == ["linear map"]
    assert [row["stage"] for row in stages if row["GB/s"] != "-"] == ["maps", "describing", "linear map"]


def test_dlib_is_measured_on_the_same_faces(benchmark: Path, predictor: Path, parts: dict[str, Dataset]) -> None:
    speeds, _, errors, against = tables(benchmark)[:4]
    (row,) = [row for row in speeds if row["method"] == "dlib"]
    numbers = ("faces/s", "from files/s", "latency ms", "first s", "peak MiB", "model MB")
    assert all(is_positive(row[name]) for name in numbers)
    assert (row["at batch"], row["compile s"]) == ("-", "-")
    (row,) = [row for row in errors if row["method"] == "dlib"]
    assert (row["faces"], row["no fit"]) == (str(len(parts["test"].faces)), "0")
    (row,) = against
    assert row["method"] == "heads"
    assert 0 < float(row["signed-rank p"]) <= 1


def test_dlib_in_two_processes_has_a_core_for_each(
    script: Any, predictor: Path, model: Path, parts: dict[str, Dataset], tmp_path: Path
) -> None:
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("needs two cores")
    faces = parts["test"].faces
    given = script.save_faces(jaxfit.load(model), faces, start_boxes(faces), tmp_path / "heads.safetensors")
    job = {"measure": "dlib", "model": str(predictor), "faces": str(given), "batches": BATCHES, "repetitions": 1}
    row = script.speed("dlib", job, [1, 1], predictor)
    assert (row["processes"], row["cores"]) == (2, 2)
    assert all(row[name] > 0 for name in ("faces/s", "latency ms", "peak MiB"))


def test_dlib_learns_where_landmarks_are(rival: Any, predictor: Path, model: Path, parts: dict[str, Dataset]) -> None:
    found = rival.load_rival(predictor, AFLW21)
    faces = parts["train"].faces
    # Boxes that it was not trained with.
    fits = rival.rival_fits(found, jaxfit.load(model), faces, start_boxes(faces, rival.BOXES))
    truth = np.stack([face.landmarks for face in faces])
    middles = start_boxes(faces)[:, None, :2] + start_boxes(faces)[:, None, 2:] / 2
    mean = (truth - middles).mean(0) + middles
    assert np.median(nmed(fits, truth, AFLW21)) < 0.7 * np.median(nmed(mean, truth, AFLW21))
    with pytest.raises(InputError, match="21"):
        rival.load_rival(predictor, jaxfit.load("sdm68").scheme)


def test_boxes_in_crops_are_those_of_the_pictures(script: Any, model: Path, parts: dict[str, Dataset]) -> None:
    faces = parts["test"].faces
    boxes = start_boxes(faces)
    crops, numbers = script.cut_crops(jaxfit.load(model), script.FINE, faces, boxes)
    assert numbers.tolist() == list(range(len(faces)))
    corners = crops.to_images(script.rectangles(crops, boxes).reshape(-1, 2, 2))
    true = np.stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], 1)
    assert (np.abs(corners - true) <= 0.51 * crops.scale[:, None, None]).all()


def test_processes_are_kept_to_their_cores(script: Any) -> None:
    before = os.sched_getaffinity(0)
    last = max(before)
    with script.kept_to([last]):
        listed = subprocess.run(
            [sys.executable, "-c", "import os; print(list(os.sched_getaffinity(0)))"],
            stdout=subprocess.PIPE,
            check=True,
        )
    assert json.loads(listed.stdout) == [last]
    assert os.sched_getaffinity(0) == before


def test_without_dlib_the_table_says_so(
    script: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(script, "dlib", None)
    arguments = script.argparse.Namespace(dlib_model="heads.dat")
    found, missing = script.rival(arguments, None, AFLW21, [])
    assert found is None
    assert 'pip install "jaxfit[bench]"' in capsys.readouterr().err
    report = load("report").Report()
    script.add_speeds(report, [], missing, jaxfit.load("sdm68"))
    table = report.parts[1]
    assert table.splitlines()[-1].startswith("| dlib: not installed | - |")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--cores", "4096"], "--cores: expected at most"),
        (["--batches", "0"], "of 1 or more"),
        (["--dlib-train", "pts:faces"], "expected --dlib-model, too"),
    ],
)
def test_what_cannot_be_measured_is_said_before_the_work(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, more: list[str], words: str
) -> None:
    assert run("benchmark", "sdm68", "--data", f"pts:{tmp_path}", "--out", str(tmp_path / "out"), *more) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
