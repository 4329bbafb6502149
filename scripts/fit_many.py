"""Fit ten thousand pictures, some of them broken, with ``jaxfit fit``; kill it in the middle, and start it again.

The pictures are links to those of a dataset under new names; the broken ones are truncated, empty, text, noise, of a
format that cannot be read, or of more pixels than any picture; a folder is named like a picture.
"""

import argparse
import csv
import os
import struct
import subprocess
import sys
import time
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from report import Report, measure, script_parser

from jaxfit.cli.arguments import add_datasets, seed
from jaxfit.errors import InputError
from jaxfit.labels.datasets import read_datasets

_POLL = 0.2  # seconds


def main() -> int:
    return measure(run, pictures_parser(__doc__).parse_args())


def pictures_parser(about: str | None) -> argparse.ArgumentParser:
    """A script's parser, with arguments for `make_pictures`, and for what fits them."""
    parser = script_parser(about)
    add_datasets(parser)
    parser.add_argument("--count", type=int, default=10_000, metavar="N", help="pictures in all (default: 10000)")
    parser.add_argument("--broken", type=float, default=0.05, metavar="SHARE", help="of them, broken (default: 0.05)")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--folder", required=True, metavar="DIR", help="a new folder, for the pictures and results")
    parser.add_argument("--fit", nargs=argparse.REMAINDER, default=[], help="all that follows goes to what fits")
    return parser


def new_folder(arguments: argparse.Namespace) -> tuple[Path, list[Path]]:
    """The folder to make, and the datasets' pictures.

    Raises:
        InputError: there is such a folder.
    """
    folder = Path(arguments.folder).absolute()
    if folder.exists():
        raise InputError(f"expected a new folder; {folder} exists")
    return folder, sorted({face.image for data in read_datasets(arguments.data, None) for face in data.faces})


def run(arguments: argparse.Namespace, report: Report) -> int:
    folder, sources = new_folder(arguments)
    tenth, whole = folder / "tenth", folder / "whole"
    broken = make_pictures(whole, sources, arguments.count, arguments.broken, arguments.seed)
    make_pictures(tenth, sources, arguments.count // 10, arguments.broken, arguments.seed)
    runs = {
        f"{arguments.count // 10} pictures": _fitted(tenth, folder / "tenth-fits", arguments.fit),
        f"{arguments.count} pictures": _fitted(whole, folder / "whole-fits", arguments.fit),
    }
    half = runs[f"{arguments.count} pictures"].seconds / 2
    runs[f"{arguments.count} pictures, killed"] = _fitted(whole, folder / "killed-fits", arguments.fit, kill_after=half)
    runs["and started again"] = _fitted(whole, folder / "killed-fits", arguments.fit)
    same = all(
        (folder / "whole-fits" / name).read_bytes() == (folder / "killed-fits" / name).read_bytes()
        for name in ("landmarks.csv", "problems.csv")
    )
    fits, problems = (_images(folder / "killed-fits" / f"{name}.csv") for name in ("landmarks", "problems"))
    names = {str(path) for path in whole.iterdir() if path.is_file()}
    kinds = Counter(broken[Path(image).name] for image in problems if Path(image).name in broken)
    rows = [{"run": name, **vars(each)} for name, each in runs.items()]
    report.table(rows, {"run": "", "seconds": ".0f", "peak_mib": ".0f", "exit": ""})
    of_kinds = ", ".join(f"{n} {kind}" for kind, n in sorted(kinds.items()))
    report.add(
        f"{len(names)} pictures: {len(fits)} with faces, {len(problems)} with a problem, {len(fits & problems)} with "
        f"both, {len(names - fits - problems)} with neither. The killed run's tables are {'' if same else 'NOT '}those "
        "of the other.",
        f"Broken pictures: {len(broken)}; reported: {sum(kinds.values())} ({of_kinds}).",
    )
    return 0 if same and not names - fits - problems else 1


@dataclass(frozen=True)
class _Run:
    """A run of ``jaxfit fit``: how long it took, the most memory that it held, and how it ended."""

    seconds: float
    peak_mib: float
    exit: int


def _fitted(pictures: Path, out: Path, options: list[str], kill_after: float | None = None) -> _Run:
    command = [sys.executable, "-m", "jaxfit", "fit", str(pictures), "--out", str(out), "--no-overlays", *options]
    began, peak = time.monotonic(), 0.0
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None:
        peak = max(peak, _resident(process.pid))
        if kill_after is not None and time.monotonic() - began > kill_after:
            process.kill()
        time.sleep(_POLL)
    return _Run(time.monotonic() - began, peak, process.returncode)


def _resident(process: int) -> float:
    """Memory that a process holds, in MiB; 0 where the system is not Linux."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def make_pictures(folder: Path, sources: list[Path], count: int, share: float, seed: int) -> dict[str, str]:
    """Make the pictures; what is wrong with the broken ones, by name."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    wrong = rng.permutation(count)[: round(share * count)]
    broken = {}
    for number in range(count):
        source = sources[number % len(sources)]
        path = folder / f"{number:06}{source.suffix}"
        if number not in wrong:
            path.symlink_to(source.resolve())
            continue
        kind = str(rng.choice(list(_BROKEN)))
        data = _BROKEN[kind](source.read_bytes(), rng)
        if kind == "heic":
            path = path.with_suffix(".heic")
        path.write_bytes(data)
        broken[path.name] = kind
    (folder / "folder.jpg").mkdir()
    return broken


def _huge(_: bytes, __: np.random.Generator) -> bytes:
    """The header of a PNG of 60,000 × 60,000 pixels."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))


_BROKEN = {
    "truncated": lambda data, rng: data[: int(rng.uniform(0.1, 0.9) * len(data))],
    "empty": lambda data, rng: b"",
    "text": lambda data, rng: b"this is no picture\n" * 9,
    "noise": lambda data, rng: rng.bytes(5000),
    "heic": lambda data, rng: b"\0\0\0\x18ftypheic" + rng.bytes(5000),
    "huge": _huge,
}


def _images(path: Path) -> set[str]:
    with path.open(encoding="utf-8", newline="") as file:
        return {row["image"] for row in csv.DictReader(file)}


if __name__ == "__main__":
    sys.exit(main())
