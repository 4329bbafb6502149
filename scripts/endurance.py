"""What is left of runs that are killed, stopped, or meet a full disk: the bytes of a run that nothing happened to.

The pictures are small and drawn at random; their faces are whole pictures, so that all time goes into the run itself.
"""

import argparse
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from report import Report, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import seed
from jaxfit.data.outputs import MANIFEST
from jaxfit.data.pictures import write_image

_SIDE = 64
_MODEL = "fast68"
_CHUNKS = ".unfinished"
_ROOMS = (0, 100_000, 1_000_000, 4_000_000, 8_000_000)  # bytes; results take some fifteen millions


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--count", type=int, default=2000, metavar="N", help="pictures (default: 2000)")
    parser.add_argument("--kills", type=int, default=12, metavar="N", help="of runs (default: 12)")
    parser.add_argument("--disk", metavar="DIR", help="an empty folder on a small disk; without, files are limited")
    parser.add_argument("--seconds", type=float, default=60.0, help="that threads fit (default: 60)")
    parser.add_argument("--seed", type=seed, default=0)
    return measure(run, parser.parse_args())


def run(options: argparse.Namespace, report: Report) -> int:
    with tempfile.TemporaryDirectory() as name:
        runs = _Runs(Path(name), options.count, random.Random(options.seed))
        good = []
        for part in options.parts:
            report.begin(part)
            good.append(PARTS[part](report, runs, options))
        return int(not all(good))


class _Runs:
    """Runs of `jaxfit fit` over the same pictures, and one that nothing happened to."""

    def __init__(self, folder: Path, count: int, chance: random.Random):
        self.chance, self.folder, self._pictures = chance, folder, folder / "pictures"
        self._pictures.mkdir()
        noise = np.random.default_rng(chance.randrange(2**32))
        for number in range(count):
            picture = cv2.GaussianBlur(noise.random((_SIDE, _SIDE), np.float32) * 255, (0, 0), 3).astype(np.uint8)
            write_image(self._pictures / f"{number:05}.png", picture)
        self.begin("whole").communicate()  # compiles as well
        begun = time.monotonic()
        self.begin("timed").communicate()
        self.seconds = time.monotonic() - begun

    def begin(self, out: str | Path, largest: int | None = None) -> subprocess.Popen[str]:
        """Begin a run; ``largest``: bytes that a file may have, as on a disk that is full then."""
        command = [sys.executable, "-m", "jaxfit", "fit", self._pictures, "--out", self.folder / out, "--model", _MODEL]
        command += ["--detector", "whole", "--no-overlays", "--format", "csv", "jsonl", "pts"]
        limit = None if largest is None else partial(resource.setrlimit, resource.RLIMIT_FSIZE, (largest, largest))
        return subprocess.Popen(
            list(map(str, command)), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, preexec_fn=limit
        )

    def same(self, out: str | Path) -> bool:
        """Whether a folder of results holds the bytes of the one that nothing happened to."""
        return _contents(self.folder / out) == _contents(self.folder / "whole")


def _contents(folder: Path) -> tuple[dict[str, bytes], dict[str, object]]:
    """What is in all files, and what the manifest says besides the time."""
    found = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    manifest = json.loads(found.pop(MANIFEST, b"{}"))
    manifest.pop("when", None)
    return found, manifest


def killed(report: Report, runs: _Runs, options: argparse.Namespace) -> bool:
    """Runs are killed at random moments until each ends by itself."""
    kills, done, whole, good = 0, [], 0, True
    while kills < options.kills:
        process, out = runs.begin("killed"), runs.folder / "killed"
        try:
            process.communicate(timeout=runs.chance.uniform(0.2, 1.0) * runs.seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            kills += 1
            done.append(len(list((out / _CHUNKS).glob("*.jsonl"))))
            _progress(f"killed {kills} of {options.kills} times, {done[-1]} chunks done")
            continue
        good, whole = good and runs.same("killed"), whole + 1
        _progress(f"ended by itself: {_outcome(good)}")
        shutil.rmtree(out)
    runs.begin("killed").communicate()
    good = good and runs.same("killed")
    report.add(
        f"Runs were killed {kills} times at random moments, when {min(done)} to {max(done)} chunks were done, and "
        f"started again; all {whole + 1} ended with {_outcome(good)}."
    )
    return good


def twins(report: Report, runs: _Runs, _: argparse.Namespace) -> bool:
    """Two to four runs at a time into one folder, stopped and continued at random."""
    refused, good = 0, True
    for count in (2, 3, 4):
        out = f"twins-{count}"
        there = [runs.begin(out) for _ in range(count)]
        while any(process.poll() is None for process in there):
            process = runs.chance.choice(there)
            if process.poll() is None:
                process.send_signal(signal.SIGSTOP)
                time.sleep(runs.chance.random())
                process.send_signal(signal.SIGCONT)
                time.sleep(runs.chance.random())
        words = [process.communicate()[1] for process in there]
        refused += sum("is being written by" in word for word in words)
        good = good and runs.same(out)
        _progress(f"{count} runs: {_outcome(good)}")
    report.add(
        f"Two, three and four runs into one folder, stopped and continued at random: {refused} were refused while "
        f"another had it, and each folder held {_outcome(good)}."
    )
    return good


def disk(report: Report, runs: _Runs, options: argparse.Namespace) -> bool:
    """Runs on a disk with little room, and those after them, with enough."""
    good, sentences = True, set()
    for room in _ROOMS:
        out, ballast = runs.folder / f"disk-{room}", None
        if options.disk:
            out, ballast = Path(options.disk) / "fits", Path(options.disk) / "ballast"
            free = os.statvfs(options.disk)
            ballast.write_bytes(bytes(max(0, free.f_bavail * free.f_frsize - room)))
        process = runs.begin(out, None if ballast else room)
        words = process.communicate()[1].strip().splitlines()[-1]
        sentences.add(re.sub(r"\S*/", "…/", words))
        if ballast:
            ballast.unlink()
        runs.begin(out).communicate()
        good = good and process.returncode == 2 and runs.same(out)
        _progress(f"room for {room:,} bytes: {_outcome(good)}")
        shutil.rmtree(out)
    report.add(
        f"{'On a disk with room for' if options.disk else 'With files of at most'} "
        f"{', '.join(f'{room:,}' for room in _ROOMS)} bytes, runs ended with a sentence, and those after them, with "
        f"enough, with {_outcome(good)}.",
        "\n".join(f"- `{sentence}`" for sentence in sorted(sentences)),
    )
    return good


def threads(report: Report, _: _Runs, options: argparse.Namespace) -> bool:
    """Eight threads fit at a time."""
    model = jaxfit.load(_MODEL)
    pictures = [np.random.default_rng(number).integers(0, 255, (_SIDE, _SIDE), np.uint8) for number in range(8)]
    boxes = np.array([[0, 0, _SIDE, _SIDE]] * 8)
    alone = jaxfit.fit(model, pictures, boxes).landmarks
    end = time.monotonic() + options.seconds

    def fit(_: int) -> tuple[int, float]:
        calls, apart = 0, 0.0
        while time.monotonic() < end:
            apart = max(apart, float(np.abs(jaxfit.fit(model, pictures, boxes).landmarks - alone).max()))
            calls += 1
        return calls, apart

    with ThreadPoolExecutor(8) as pool:
        calls, apart = zip(*pool.map(fit, range(8)), strict=True)
    report.add(
        f"Eight threads called `jaxfit.fit` {sum(calls):,} times in {options.seconds:g} seconds, each at least "
        f"{min(calls)} times; landmarks were at most {max(apart):.2g} pixels from those of a call alone."
    )
    return max(apart) < 1e-3


def _progress(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _outcome(same: bool) -> str:
    return "the bytes of a run that nothing happened to" if same else "OTHER results"


PARTS = {"killed": killed, "twins": twins, "disk": disk, "threads": threads}


if __name__ == "__main__":
    sys.exit(main())
