"""Fit ten thousand pictures, some of them broken, with ``jaxfit collect``, killed in several ways, and ``jaxfit fit``.

The pictures are those of scripts/fit_many.py. Of the runs of ``jaxfit collect``, one goes through, one has a worker
killed in the middle (SIGKILL), and one is itself killed in the middle, and started again. Processor seconds are those
of all processes of a run, Ray's own among them, as they were last seen.
"""

import argparse
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from fit_many import make_pictures, new_folder, pictures_parser
from report import Report, measure

from jaxfit.errors import InputError

_POLL = 0.2  # seconds
_ORDER = [("image", "ascending"), ("face", "ascending")]


def main() -> int:
    parser = pictures_parser(__doc__)
    parser.add_argument("--workers", type=int, default=2, help="of jaxfit collect (default: 2)")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> int:
    folder, sources = new_folder(arguments)
    pictures = folder / "pictures"
    make_pictures(pictures, sources, arguments.count, arguments.broken, arguments.seed)

    def parts(name: str) -> list[Path]:
        return sorted((folder / name / "parts").glob("[!.]*.parquet"))

    def collect(name: str, half: Callable[[psutil.Process], None] | None = None) -> _Run:
        """A run into this folder; once it has half of the parts of the first one, ``half`` is done to it."""
        options = ["--workers", str(arguments.workers), *arguments.fit]
        due = None if half is None else lambda: len(parts(name)) >= len(parts("collected")) / 2
        return _run("collect", pictures, folder / name, options, due, half)

    runs = {
        "`jaxfit fit`, one process": _run(
            "fit", pictures, folder / "fitted", ["--format", "parquet", "--no-overlays", *arguments.fit]
        ),
        "`jaxfit collect`": collect("collected"),
        "a worker killed": collect("worker-killed", _kill_worker),
        "all killed": collect("all-killed", psutil.Process.kill),
    }
    before = {path: path.stat().st_mtime_ns for path in parts("all-killed")}
    runs["and started again"] = collect("all-killed")
    again = sum(path.stat().st_mtime_ns != written for path, written in before.items())
    columns = {"run": "", "seconds": ".0f", "cpu_seconds": ".0f", "of_workers": ".0f", "exit": ""}
    report.table([{"run": name, **vars(each)} for name, each in runs.items()], columns)
    names = sorted(str(path) for path in pictures.iterdir() if path.is_file() or path.is_symlink())
    expected = pq.read_table(folder / "fitted" / "landmarks.parquet").sort_by(_ORDER)
    first, all_well = _faces(folder / "collected", expected), not again
    for name in ("collected", "worker-killed", "all-killed"):
        faces, (once, outcomes) = _faces(folder / name, expected), _accounted(folder / name, names)
        all_well &= once and faces.equals(first)
        report.add(
            f"{name}: each picture is {'' if once else 'NOT '}in one part and once in the manifest: {outcomes}. "
            f"{len(faces)} faces, {'' if faces.equals(first) else 'NOT '}those of the first run."
        )
    apart = _difference(first, expected)
    report.add(f"Of the {len(expected)} faces of `jaxfit fit` they differ by at most {apart:.4f} pixels.")
    inwards = sum(path.stat().st_size for path in pictures.iterdir() if path.is_file())
    outwards = sum(path.stat().st_size for path in (*parts("collected"), folder / "collected" / "manifest.parquet"))
    report.add(
        f"Of {len(before)} parts that were there when all was killed, {again} were written again.",
        f"Bytes a picture: {inwards / len(names):.0f} in, {outwards / len(names):.0f} out.",
    )
    return 0 if all_well else 1


def _accounted(out: Path, names: Sequence[str]) -> tuple[bool, str]:
    """Whether each picture is accounted for exactly once, and the outcomes."""
    manifest = pq.read_table(out / "manifest.parquet")
    parts = [pq.read_table(path, columns=["image", "face"]) for path in (out / "parts").glob("[!.]*.parquet")]
    in_parts = [image for part in parts for image in part["image"].unique().to_pylist()]
    once = sorted(in_parts) == names and sorted(manifest["image"].to_pylist()) == names
    once &= all(part.group_by(["image", "face"]).aggregate([]).num_rows == len(part) for part in parts)
    outcomes = Counter(manifest["outcome"].to_pylist())
    return once, ", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items()))


def _faces(out: Path, like: pa.Table) -> pa.Table:
    """The fitted faces of a run of ``jaxfit collect``, with the columns of another table."""
    table = pq.read_table(out / "parts")
    return table.filter(pc.equal(table["problem"], "")).select(like.column_names).sort_by(_ORDER)


def _difference(one: pa.Table, other: pa.Table) -> float:
    """The largest of any number; infinite if the faces are not the same."""
    words = ["image", "face", "box"]
    if not one.select(words).equals(other.select(words)):
        return np.inf
    return float(max(np.abs(one[name].to_numpy() - other[name].to_numpy()).max() for name in one.column_names[3:]))


@dataclass(frozen=True)
class _Run:
    """A run of a command: how long it took, the processor time of all its processes, of which Ray's workers, and
    how it ended."""

    seconds: float
    cpu_seconds: float
    of_workers: float
    exit: int


def _run(
    command: str,
    pictures: Path,
    out: Path,
    options: Sequence[str],
    due: Callable[[], bool] | None = None,
    half: Callable[[psutil.Process], None] | None = None,
) -> _Run:
    """Run a command; when it is due, do something to it."""
    began, used, workers = time.monotonic(), dict[psutil.Process, float](), set[psutil.Process]()
    with out.with_suffix(".log").open("a") as log:
        process = psutil.Popen(
            [sys.executable, "-m", "jaxfit", command, str(pictures), "--out", str(out), *options],
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    family: list[psutil.Process] = []
    while process.poll() is None:
        try:
            family = [process, *process.children(recursive=True)]
            for each in family:
                used[each] = sum(each.cpu_times()[:2])
            workers.update(_workers(process))
        except psutil.NoSuchProcess:
            pass
        if due is not None and half is not None and due():
            half(process)
            due = None
        time.sleep(_POLL)
    seconds = time.monotonic() - began
    if process.returncode not in (0, -signal.SIGKILL):
        raise InputError(f"jaxfit {command} failed: see {out.with_suffix('.log')}")
    psutil.wait_procs(family[1:], timeout=120)  # Ray's own processes end when they miss theirs
    return _Run(seconds, sum(used.values()), sum(used.get(each, 0.0) for each in workers), process.returncode)


def _kill_worker(process: psutil.Process) -> None:
    _workers(process)[0].kill()


def _workers(process: psutil.Process) -> list[psutil.Process]:
    """The workers of Ray Data that a process has."""
    return [each for each in process.children(recursive=True) if "MapWorker" in " ".join(each.cmdline())]


if __name__ == "__main__":
    sys.exit(main())
