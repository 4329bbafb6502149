"""Measure models and a rival, dlib's shape predictor, on the same faces and boxes in one run.

Speed on some numbers of cores, latency of one face, time to compile, memory, sizes, errors; then where the time goes,
stage by stage, beside what the machine can do. Whatever is timed is timed in a process of its own.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_dlib import FINE, cut_crops, dlib, load_rival, rectangles, rival_fits, train_rival
from report import Report, dataset_names, measure, save_figure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets, out_folder
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.outputs import write_csv
from jaxfit.data.pictures import read_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.plots import new_figure
from jaxfit.evaluation.tables import COMPARISON_COLUMNS, SUMMARY_COLUMNS, comparison_row, summary_row
from jaxfit.fitting.batches import BATCHES
from jaxfit.labels.datasets import read_datasets, shared_scheme
from jaxfit.labels.records import FaceRecord, copies_of
from jaxfit.models.model import Model
from jaxfit.schemes.normalisers import NORMALISERS
from jaxfit.schemes.scheme import Scheme

HERE = Path(__file__).resolve().parent
RIVAL = "dlib"
STAGES_AT_ONCE = 256  # faces, at most
FILES = 1024  # pictures that are read from disk, at most
FIRSTS = 3  # processes whose first results are timed
SPEED_COLUMNS = {
    "method": "",
    "processes": "d",
    "cores": "d",
    "faces/s": ".0f",
    "at batch": "d",
    "from files/s": ".0f",
    "latency ms": ".2f",
    "first s": ".2f",
    "load s": ".2f",
    "compile s": ".1f",
    "peak MiB": ".0f",
    "model MB": ".1f",
}
CSV_COLUMNS = [*(name for name in SPEED_COLUMNS if name != "at batch"), "batch"]


def main() -> int:
    parser = script_parser(__doc__, out="benchmark.md, benchmark.csv, sizes.csv and plots")
    parser.add_argument("models", nargs="+", metavar="MODEL", help="model files or names of bundled models")
    add_datasets(parser)
    parser.add_argument("--normaliser", choices=NORMALISERS, default="outer")
    parser.add_argument("--dlib-model", metavar="FILE", help="dlib's shape predictor; trained if there is no such file")
    parser.add_argument("--dlib-train", nargs="+", metavar="SPEC", help="datasets to train it on, not those of --data")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 8, 64, 128, 256, 512, 1024], metavar="FACES")
    parser.add_argument("--cores", type=int, nargs="+", default=[1, 2], help="numbers of cores to measure on")
    parser.add_argument("--repetitions", type=int, default=9, help="of each measurement; the median counts")
    parser.add_argument("--seed", type=int, default=0, help="of the boxes")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    require_measurable(arguments)
    load_before = os.getloadavg()[0]
    folder = out_folder(arguments.out)
    figure = new_figure(14.0, 4.5)  # without matplotlib it stops here, before the work
    models = {Path(name).stem: jaxfit.load(name) for name in arguments.models}
    if len(models) < len(arguments.models) or RIVAL in models:
        raise InputError(f"expected models of different names, none {RIVAL}; got {' '.join(arguments.models)}")
    datasets = read_datasets(arguments.data, arguments.scheme)
    scheme = shared_scheme(datasets)
    folders = dataset_names(datasets)
    names = [name for name, each in zip(folders, datasets, strict=True) for face in each.faces if face.complete]
    faces = [face for dataset in datasets for face in dataset.faces if face.complete]
    boxes = start_boxes(faces, arguments.seed)
    first = next(iter(models.values()))
    predictor, missing = rival(arguments, first, scheme, faces)

    errors: dict[str, np.ndarray] = {}
    learned: dict[str, np.ndarray | None] = {}
    problems: list[str] = []
    with Bars() as bars:
        for name, model in models.items():
            result = jaxfit.evaluate(model, faces, boxes, scheme=scheme, normaliser=arguments.normaliser, progress=bars)
            errors[name], learned[name] = result.errors, result.learned
            problems += [f"{name}: {problem}" for problem in result.fits.problems]
    if predictor:
        truth = np.stack([face.landmarks for face in faces])
        errors[RIVAL] = nmed(rival_fits(predictor, first, faces, boxes), truth, scheme, arguments.normaliser)
    report_problems(problems)

    with tempfile.TemporaryDirectory() as scratch:
        files = {name: Path(scratch) / f"{name}.safetensors" for name in models}
        for name, model in models.items():
            jaxfit.save(model, files[name])
        given = {name: save_faces(model, faces, boxes, files[name]) for name, model in models.items()}
        common = {"batches": arguments.batches, "repetitions": arguments.repetitions}
        rows: list[dict[str, Any]] = []
        stages, sizes = [], {}
        for cores in arguments.cores:
            for name, path in files.items():
                job = {"measure": "jaxfit", "model": str(path), "faces": str(given[name]), **common}
                rows.append(speed(name, job, [cores], path))
            if predictor:
                path = Path(arguments.dlib_model)
                job = {"measure": "dlib", "model": str(path), "faces": str(given[next(iter(models))]), **common}
                rows.append(speed(RIVAL, job, [1] * cores, path))
            stages.append(stage_table(list(files.values()), cores, arguments))
        for name, path in files.items():
            job = {"measure": "sizes", "model": str(path), "faces": str(given[name])}
            job |= {"batch": BATCHES[0], "repetitions": arguments.repetitions}
            print(f"{name}: fewer steps and landmarks …", file=sys.stderr, flush=True)
            sizes[name] = measured(job, [max(arguments.cores)])[0]

    write_csv(folder / "benchmark.csv", CSV_COLUMNS, csv_rows(rows))
    write_csv(
        folder / "sizes.csv",
        ["method", "size", "count", "faces/s"],
        [[name, size, *each] for name, found in sizes.items() for size, rates in found.items() for each in rates],
    )
    plot_speeds(figure, rows, sizes)
    save_figure(figure, folder / "throughput.png", dpi=150)
    report.title = "Benchmark"
    report.add(
        f"1-minute load average when it began: {load_before:.2f}. Warm; medians of {arguments.repetitions}, from files "
        f"of {min(3, arguments.repetitions)}; first results of {FIRSTS} processes, one after the other."
    )
    add_speeds(report, rows, missing, first)
    add_errors(report, errors, learned, names, faces, arguments.normaliser)
    report.add(*stages)


def require_measurable(arguments: argparse.Namespace) -> None:
    if min(*arguments.batches, *arguments.cores, arguments.repetitions) < 1:
        raise InputError("expected --batches, --cores and --repetitions of 1 or more; got a smaller one")
    if not hasattr(os, "sched_setaffinity"):
        raise InputError("processes can be kept to some of the cores on Linux alone; run it there")
    here = len(os.sched_getaffinity(0))
    if max(arguments.cores) > here:
        raise InputError(f"--cores: expected at most {here}, which is all there are; got {max(arguments.cores)}")
    if arguments.dlib_train and not arguments.dlib_model:
        raise InputError("--dlib-train: expected --dlib-model, too: the file that the trained predictor goes to")


def rival(arguments: argparse.Namespace, model: Model, scheme: Scheme, faces: Sequence[FaceRecord]) -> tuple[Any, str]:
    """dlib's shape predictor, trained if need be on other pictures than those of ``faces``; or None, and why."""
    if not arguments.dlib_model:
        return None, "no --dlib-model"
    if dlib is None:
        print('dlib is left out, as it is not installed: pip install "jaxfit[bench]"', file=sys.stderr)
        return None, "not installed"
    path = Path(arguments.dlib_model)
    if not path.exists():
        if not (arguments.dlib_train and path.parent.is_dir()):
            raise InputError(
                f"--dlib-model: there is no {path}; expected a file, or --dlib-train and a name in a folder that exists"
            )
        datasets = read_datasets(arguments.dlib_train, arguments.scheme)
        if (other := shared_scheme(datasets)) != scheme:
            raise InputError(f"--dlib-train: expected labels of {scheme.name} as those of --data; got {other.name}")
        complete = [face for dataset in datasets for face in dataset.faces if face.complete]
        tested = [
            copies_of([face.image for face in faces], [face.image for face in dataset.faces]) for dataset in datasets
        ]
        others = [face for face in complete if not any(face.image in copies for copies in tested)]
        print(
            f"dlib's training: {len(others)} of {len(complete)} faces; --data has the others' pictures", file=sys.stderr
        )
        train_rival(path, model, others, scheme)
    return load_rival(path, scheme), ""


def save_faces(model: Model, faces: Sequence[FaceRecord], boxes: np.ndarray, path: Path) -> Path:
    """Write what a process needs to measure: crops, rectangles in them, and one picture with its box and rectangle."""
    crops, numbers = cut_crops(model, model.cascade.frame, faces, boxes)
    if not numbers.size:
        raise InputError("--data: expected faces with pictures and all their landmarks; got none")
    box = boxes[numbers[0]]
    rectangle = np.rint([*box[:2], *(box[:2] + box[2:])]).astype(int)
    picture = read_grey(faces[numbers[0]].image)
    sides = rectangles(crops, boxes[numbers])
    path, some = path.with_suffix(".npz"), numbers[:FILES]
    np.savez(
        path,
        crops=crops.pixels,
        rectangles=sides,
        picture=picture,
        box=box,
        rectangle=rectangle,
        paths=np.array([str(faces[number].image) for number in some]),
        boxes=boxes[some],
        in_pictures=np.rint(np.concatenate([boxes[some, :2], boxes[some, :2] + boxes[some, 2:]], 1)).astype(int),
    )
    return path


def speed(name: str, job: dict[str, Any], cores: list[int], model: Path) -> dict[str, Any]:
    """What processes that work at once, each on so many ``cores`` of its own, do together."""
    print(f"{name}: cores of each process: {' '.join(map(str, cores))} …", file=sys.stderr, flush=True)
    found = measured(job, cores)
    each = zip(*(one["speeds"] for one in found), strict=True)
    speeds = [
        {
            "batch": of_batch[0]["batch"],
            "faces/s": sum(one["faces/s"] for one in of_batch),
            "peak MiB": sum(one["peak MiB"] for one in of_batch),
        }
        for of_batch in each
    ]
    best = max(speeds, key=lambda each: each["faces/s"])
    return {
        "method": name,
        "processes": len(cores),
        "cores": sum(cores),
        "faces/s": best["faces/s"],
        "at batch": best["batch"],
        "from files/s": sum(one["from files/s"] for one in found),
        "latency ms": float(np.mean([one["latency ms"] for one in found])),
        "first s": first_result(job, cores[0]),
        "load s": max(one["load s"] for one in found),
        "compile s": found[0].get("compile s"),
        "peak MiB": sum(one["peak MiB"] for one in found),
        "model MB": model.stat().st_size / 1e6,
        "speeds": speeds,
    }


def first_result(job: dict[str, Any], cores: int) -> float:
    """Seconds from the start of a process to its first fit, when an earlier one has left what it compiled."""
    job = {"measure": f"{job['measure']} first", "model": job["model"], "faces": job["faces"]}
    times = []
    with tempfile.TemporaryDirectory() as cache, kept_to(sorted(os.sched_getaffinity(0))[:cores]):
        for _ in range(1 + FIRSTS):
            command = [sys.executable, str(HERE / "benchmark_worker.py"), json.dumps(job | {"begin": time.time()})]
            compiled = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False, env=compiled)
            if done.returncode:
                raise SystemExit(f"failed: {' '.join(command)}")
            times.append(json.loads(done.stdout))
    return float(np.median(times[1:]))


def measured(job: dict[str, Any], cores: list[int]) -> list[dict[str, Any]]:
    """What processes find that do a job at once, each on so many ``cores`` of its own."""
    free = sorted(os.sched_getaffinity(0))
    command = [sys.executable, str(HERE / "benchmark_worker.py"), json.dumps(job)]
    with ExitStack() as stack:
        workers = []
        for count in cores:
            with kept_to(free[:count]):
                worker = subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()
                )
            workers.append(stack.enter_context(worker))
            stack.callback(worker.kill)  # if another one fails
            free = free[count:]
        for worker in workers:
            if worker.stdout is None or worker.stdout.readline() != "ready\n":
                raise SystemExit(f"failed: {' '.join(command)}")
        for worker in workers:
            assert worker.stdin is not None
            worker.stdin.write("\n")
            worker.stdin.flush()
        found = [worker.communicate()[0] for worker in workers]
        if any(worker.returncode for worker in workers):
            raise SystemExit(f"failed: {' '.join(command)}")
    return [json.loads(text) for text in found]


@contextmanager
def kept_to(cores: Sequence[int]) -> Iterator[None]:
    """Processes that are started meanwhile have these cores from their beginning."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def environment() -> dict[str, str]:
    """Variables of processes that are to compile whatever they run."""
    return {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}


def stage_table(models: list[Path], cores: int, arguments: argparse.Namespace) -> str:
    print(f"stages: {cores} core{'s' if cores > 1 else ''} …", file=sys.stderr, flush=True)
    command = [sys.executable, str(HERE / "benchmark_stages.py"), *map(str, models)]
    command += ["--batch", str(min(max(arguments.batches), STAGES_AT_ONCE))]
    command += ["--repetitions", str(arguments.repetitions)]
    with kept_to(sorted(os.sched_getaffinity(0))[:cores]):
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"failed: {' '.join(command)}")
    return done.stdout.strip()


def csv_rows(rows: Sequence[dict[str, Any]]) -> Iterator[list[object]]:
    """A row for each batch; what does not depend on it is repeated."""
    for row in rows:
        for of_batch in row["speeds"]:
            values = row | of_batch
            yield ["" if values[name] is None else values[name] for name in CSV_COLUMNS]


def plot_speeds(
    figure: Any, rows: Sequence[dict[str, Any]], sizes: dict[str, dict[str, list[tuple[int, float]]]]
) -> None:
    """Throughput against batch size, where methods that know no batches are level, dashed lines; steps; landmarks."""
    ax, *others = figure.subplots(1, 3)
    for row in rows:
        label = f"{row['method']}, {workplace(row)}"
        batches = [each["batch"] for each in row["speeds"]]
        rates = [each["faces/s"] for each in row["speeds"]]
        if batches == [None]:
            ax.axhline(rates[0], linestyle="--", color="0.2" if row["cores"] > 1 else "0.6", label=label)
        else:
            ax.plot(batches, rates, marker="o", label=label)
            ax.set_xscale("log", base=2)
            ax.set_xticks(batches, list(map(str, batches)))
    ax.set_ylim(bottom=0)
    ax.set(xlabel="faces in a batch", ylabel="faces/s")
    ax.legend()
    for other, size in zip(others, ("steps", "landmarks"), strict=True):
        for name, found in sizes.items():
            if points := found.get(size):
                label = f"{name}, batches of {BATCHES[0]}, on {max(row['cores'] for row in rows)} cores"
                other.plot(*zip(*points, strict=True), marker="o", label=label)
        other.set_ylim(bottom=0)
        other.set(xlabel=size, ylabel="faces/s")
        other.legend()
    for each in (ax, *others):
        each.grid(alpha=0.3)


def workplace(row: dict[str, Any]) -> str:
    """Where a row was measured."""
    if row["processes"] > 1:
        return f"{row['processes']} processes"
    return f"{row['cores']} core{'s' if row['cores'] > 1 else ''}"


def add_speeds(report: Report, rows: Sequence[dict[str, Any]], missing: str, model: Model) -> None:
    """Speed and memory of each method, then its speed by the size of batches."""
    frame = model.cascade.frame
    left_out = [{"method": f"{RIVAL}: {missing}"}] if missing else []
    by_batch: dict[int, dict[str, Any]] = {}
    for row in rows:
        for each in row["speeds"]:
            if each["batch"] is not None:
                at_batch = by_batch.setdefault(each["batch"], {"batch": each["batch"]})
                at_batch[f"{row['method']}, {workplace(row)}"] = each["faces/s"]
    columns = dict.fromkeys((name for at_batch in by_batch.values() for name in at_batch), ".0f")
    report.table(
        [*rows, *left_out],
        SPEED_COLUMNS,
        above="faces/s: from uint8 grey crops to landmarks in their pixels (`fit_crops` of `jaxfit.cascade`, as many "
        "batches at the same time as `jaxfit.fit` computes), at the best batch. From files: `jaxfit.fit` of "
        "pictures on disk, which the system has read before, and boxes. Latency: one face of a picture that has "
        "been read (`jaxfit.fit`). First: from the start of a process to its first fit, all imports included, "
        "with JAX's cache of what earlier ones compiled. Compile: `jaxfit.warm_up` in a fresh process, with "
        "nothing kept from earlier ones; peak memory is that of a process that does this and fits single faces. "
        f"dlib gets the same faces one by one: the {frame.crop} × {frame.crop} crops of the first model with the "
        "box, in whole pixels, that the crop was cut for; its points are not read into arrays. Its binding keeps "
        "to one core, so that more cores have a process each, which work at once: rates and memory are their "
        "sums.",
    )
    report.table(list(by_batch.values()), columns, above="faces/s by batch:")


def add_errors(
    report: Report,
    errors: dict[str, np.ndarray],
    learned: Mapping[str, np.ndarray | None],
    names: list[str],
    faces: Sequence[FaceRecord],
    normaliser: str,
) -> None:
    """Each method's errors, and how those of ours differ from the rival's."""
    of_faces = np.array(names)
    groups = {name: of_faces == name for name in dict.fromkeys(names)}
    if len(groups) > 1:
        groups["all"] = np.ones(len(names), bool)
    subjects = np.array([f"{name}/{face.subject}" for name, face in zip(names, faces, strict=True)])

    def of_group(method: str, group: np.ndarray) -> np.ndarray | None:
        known = learned.get(method)
        return None if known is None else known[group]

    report.table(
        [
            {"dataset": name, "method": method, **summary_row(found[group], subjects[group], of_group(method, group))}
            for name, group in groups.items()
            for method, found in errors.items()
        ],
        {"dataset": "", "method": "", **SUMMARY_COLUMNS},
        above=f"NMED over {NORMALISERS[normaliser].title}, on the same faces and boxes. Faces without a fit count in "
        "the median, the AUC and the failures. dlib finds whole pixels, here those of crops of "
        f"{FINE.crop} × {FINE.crop}.",
    )
    if RIVAL in errors:
        rows = [
            {"dataset": name, "method": method, **comparison_row(found[group], errors[RIVAL][group], subjects[group])}
            for name, group in groups.items()
            for method, found in errors.items()
            if method != RIVAL
        ]
        columns = {"dataset": "", "method": "", **COMPARISON_COLUMNS}
        report.table(rows, columns, above=f"Compared with {RIVAL}; below zero is better:")


if __name__ == "__main__":
    sys.exit(main())
