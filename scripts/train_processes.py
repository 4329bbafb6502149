"""Train and evaluate in one process and in several on this machine: time, memory, and whether the results are the same.

Then one of the processes is killed, in training and in evaluation: how long the others live, and what is left.
"""

import argparse
import csv
import os
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from report import Report, measure, script_parser

from jaxfit.cli.arguments import add_datasets
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import JaxfitError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.labels.datasets import read_datasets
from jaxfit.models.files import load

_POLL = 0.05  # seconds


@dataclass(frozen=True)
class Ended:
    """A process that ended: how, after how many seconds, how many of them on a core, with how much memory, in MiB."""

    status: int
    seconds: float
    cpu: float
    peak: float


def main() -> int:
    parser = script_parser(__doc__)
    add_datasets(parser)
    parser.add_argument("--test", required=True, metavar="SPEC", help="the dataset to evaluate on")
    parser.add_argument("--processes", type=int, default=2, metavar="N")
    parser.add_argument("--train", nargs=argparse.REMAINDER, default=[], help="all that follows goes to jaxfit train")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    count = arguments.processes
    scheme = ["--scheme", arguments.scheme] if arguments.scheme else []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        models = {number: folder / f"{number}.safetensors" for number in (1, count)}
        train = ["train", "--data", *arguments.data, *scheme, *arguments.train, "--out"]
        test = ["evaluate", str(models[1]), "--data", arguments.test, *scheme, "--out"]
        rows = []
        for work, command, targets in (
            ("training", train, models),
            ("evaluation", test, {number: folder / str(number) for number in (1, count)}),
        ):
            for number, target in targets.items():
                for index, ended in enumerate(all_ended(started([*command, str(target)], number, folder), 0)):
                    rows.append({"work": work, "processes": number, "process": index, **vars(ended)})
        columns = {"work": "", "processes": "d", "process": "d", "seconds": ".0f", "cpu": ".0f", "peak": ".0f"}
        report.table(rows, columns)
        report.add(_compared(models[1], models[count], arguments.test, arguments.scheme))
        errors = [_errors(folder / str(number) / "faces.csv") for number in (1, count)]
        unlike = np.abs(errors[0] - errors[1]).max()
        report.add(f"NMED of one model's fits in 1 and in {count} processes: at most {unlike:.1e} apart.")
        rows = []
        for work, command, stage in (("training", train, "step 1/"), ("evaluation", test, "fitting")):
            for victim in range(count):
                target = folder / f"{work}-{victim}{'.safetensors' if command is train else ''}"
                rows += _killed([*command, str(target)], count, folder, victim, stage, target)
        columns = {"work": "", "killed": "d", "process": "d", "seconds after": ".1f", "status": "d"}
        report.table(rows, {**columns, "says": "", "left": ""})


def started(command: list[str], count: int, folder: Path) -> list[subprocess.Popen]:
    """So many processes of ``jaxfit`` with a command; what each prints goes to a file ``said-NUMBER``."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        joined = ["--coordinator", f"127.0.0.1:{probe.getsockname()[1]}", "--processes", str(count), "--process"]
    processes = []
    for index in range(count):
        with open(folder / f"said-{index}", "w") as said:
            words = [sys.executable, "-m", "jaxfit", *command, *([*joined, str(index)] if count > 1 else [])]
            processes.append(subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=said))
    return processes


def all_ended(processes: list[subprocess.Popen], require: int | None = None) -> list[Ended]:
    """How processes ended, once all have.

    Raises:
        JaxfitError: one has another exit status than the required one.
    """
    begin, ended = time.perf_counter(), dict[int, Ended]()
    while len(ended) < len(processes):
        for index, process in enumerate(processes):
            if index in ended:
                continue
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                process.returncode = os.waitstatus_to_exitcode(status)
                cpu = usage.ru_utime + usage.ru_stime
                ended[index] = Ended(process.returncode, time.perf_counter() - begin, cpu, usage.ru_maxrss / 1024)
                if require not in (None, process.returncode):
                    raise JaxfitError(f"expected exit status {require}; got {process.returncode} of {process.args!r}")
        time.sleep(_POLL)
    return [ended[index] for index in range(len(processes))]


def _killed(
    command: list[str], count: int, folder: Path, victim: int, stage: str, target: Path
) -> list[dict[str, object]]:
    """A row for each process that is left when one is killed at a stage that the first has reported."""
    processes = started(command, count, folder)
    while stage not in (folder / "said-0").read_text():
        time.sleep(_POLL)
    processes[victim].kill()
    rows = []
    for index, ended in enumerate(all_ended(processes)):
        if index != victim:
            said = (folder / f"said-{index}").read_text()
            says = "jaxfit" if "another process ended" in said else "JAX" if "another task died" in said else "nothing"
            left = [*target.iterdir()] if target.is_dir() else [target] if target.exists() else []
            row = {"work": command[0], "killed": victim, "process": index, "seconds after": ended.seconds}
            rows.append({**row, "status": ended.status, "says": says, "left": f"{len(left)} files"})
    return rows


def _compared(one: Path, other: Path, test: str, scheme: str | None) -> str:
    """How far the fits of two models are from one another."""
    (dataset,) = read_datasets([test], scheme)
    boxes, read = start_boxes(dataset.faces), GreyPictures()
    of_one, of_other = (evaluate(load(path), dataset.faces, boxes, read=read) for path in (one, other))
    distances = np.linalg.norm(of_one.landmarks - of_other.landmarks, axis=2).max(1) / boxes[:, 2]
    medians = [float(np.median(result.errors)) for result in (of_one, of_other)]
    return (
        f"Fits of {len(boxes)} faces by the two models: the landmark that is farthest from the other model's is "
        f"{np.nanmedian(distances):.1e} of the face box's side from it in the median face, {np.nanmax(distances):.1e} "
        f"in the worst. Median NMED {medians[0]:.5f} and {medians[1]:.5f}."
    )


def _errors(path: Path) -> np.ndarray:
    with open(path, encoding="utf-8") as file:
        return np.array([float(row["nmed"]) for row in csv.DictReader(file)])


if __name__ == "__main__":
    sys.exit(main())
