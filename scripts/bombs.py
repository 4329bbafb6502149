"""Small files that stand for large pictures, or for much work: what reading them costs, in seconds and memory.

Each is read in a process of its own, within the limits that are the default: pictures of nearly as many pixels as are
allowed, then other files. At last, ``jaxfit fit`` goes through all of the pictures, and is stopped by Ctrl-C.
"""

import argparse
import os
import signal
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from report import Report, measure, script_parser

from jaxfit.data.limits import DEFAULT_MEGAPIXELS
from jaxfit.data.pictures import find_images, read_image
from jaxfit.errors import ImageError

_SIDE = int((DEFAULT_MEGAPIXELS * 1e6) ** 0.5) // 8 * 8
_LESS = int((DEFAULT_MEGAPIXELS / 2.5 * 1e6) ** 0.5) // 8 * 8  # of formats whose pixels count more
_PICTURE, _AFLW, _MATLAB, _TOML, _MODEL = (
    "jaxfit.data.pictures:read_image",
    "jaxfit.labels.importers.aflw:read_aflw",
    "jaxfit.labels.importers.matlab:read_matlab",
    "jaxfit.experiments.config:read_config",
    "jaxfit.models.files:load",
)
_READ = """
import importlib, sys, time
from jaxfit.errors import JaxfitError
room, _, name = sys.argv[1].partition(":")
read = getattr(importlib.import_module(room), name)
with open("/proc/self/clear_refs", "w") as file:
    file.write("5")  # the most memory so far is forgotten
def memory(name):
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith(name)) / 1024
before, begun = memory("VmRSS"), time.perf_counter()
try:
    read(sys.argv[2])
    outcome = "read"
except JaxfitError as error:
    outcome = "refused"
print(outcome, time.perf_counter() - begun, memory("VmHWM") - before)
"""
_COSTS = {"file": "", "kB": ",.0f", "megapixels": ".0f", "outcome": "", "seconds": ".1f", "MiB": ",.0f"}
_NOISE = "noise."
_DELAYS = (0.5, 2.0, 5.0, 9.0)  # seconds after which Ctrl-C is pressed
_LATEST = 2.0  # seconds until it has to be heard
_MOST_SECONDS, _MOST_MIB = 30.0, 3072.0  # of a picture


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--only", nargs="+", choices=PICTURES, default=list(PICTURES), metavar="FILE")
    parser.add_argument("--folder", metavar="DIR", help="where the bombs are, or are made, and stay")
    parser.add_argument("--pictures", nargs="*", default=[], metavar="DIR", help="real ones, none of which is a bomb")
    return measure(run, parser.parse_args())


def run(options: argparse.Namespace, report: Report) -> int:
    with ExitStack() as stack:
        folder = Path(options.folder or stack.enter_context(tempfile.TemporaryDirectory()))
        over = []
        for name in options.parts:
            report.begin(name)
            over.append(PARTS[name](report, folder, options.only))
    if options.pictures:
        report.begin("real")
        report.add(_refused(options.pictures))
    return int(any(over))


def pictures(report: Report, folder: Path, only: Sequence[str]) -> bool:
    """What each black picture costs; whether one is over the budget."""
    return _pictures(report, folder, [name for name in only if not name.startswith(_NOISE)], "Black pictures")


def noise(report: Report, folder: Path, only: Sequence[str]) -> bool:
    """What each picture of noise costs; whether one is over the budget."""
    return _pictures(report, folder, [name for name in only if name.startswith(_NOISE)], "Noise")


def _pictures(report: Report, folder: Path, names: Sequence[str], what: str) -> bool:
    rows = [_cost(path, _PICTURE, PICTURES[path.name][0]) for path in _bombs(folder, names)]
    report.table(
        rows,
        _COSTS,
        f"{what} of nearly as many pixels as are allowed ({DEFAULT_MEGAPIXELS:g} megapixels, fewer in some formats), "
        "of as many scans, or of as many bytes; read by `read_image`, each in a process of its own. The budget is "
        f"{_MOST_SECONDS:g} seconds and {_MOST_MIB:,.0f} MiB each.",
    )
    return any(row["seconds"] > _MOST_SECONDS or row["MiB"] > _MOST_MIB for row in rows)


def others(report: Report, folder: Path, _: Sequence[str]) -> bool:
    """What files cost that are no pictures; whether one is read."""
    with tempfile.TemporaryDirectory(dir=folder) as name:
        rows = [_cost(write(Path(name) / file), read) for file, (read, write) in OTHERS.items()]
    columns = {name: form for name, form in _COSTS.items() if name != "megapixels"}
    report.table(rows, columns, "Files of no pictures, or of none that is read.")
    return any(row["outcome"] != "refused" for row in rows)


def whole(report: Report, folder: Path, only: Sequence[str]) -> bool:
    """What `jaxfit fit` takes for all of the pictures."""
    paths = _bombs(folder, only)
    with tempfile.TemporaryDirectory(dir=folder) as name:
        begun = time.monotonic()
        process = _fit(paths, Path(name))
        assert process.stderr is not None
        process.stderr.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.monotonic() - begun
    report.add(
        f"`jaxfit fit` goes through {len(paths)} pictures in {seconds:.0f} seconds, and holds at most "
        f"{used.ru_maxrss / 1024:,.0f} MiB, JAX and the model included."
    )
    return process.returncode not in (0, 1)  # without a face in any of them


def stopped(report: Report, folder: Path, only: Sequence[str]) -> bool:
    """How soon `jaxfit fit` hears Ctrl-C; whether it is too late."""
    paths, late = _bombs(folder, only), []
    for delay in _DELAYS:
        with tempfile.TemporaryDirectory(dir=folder) as name:
            process = _fit(paths, Path(name))
            assert process.stderr is not None
            process.stderr.readline()  # the stage that has begun
            time.sleep(delay)
            pressed = time.monotonic()
            process.send_signal(signal.SIGINT)
            process.communicate()
            late.append(time.monotonic() - pressed)
    report.add(
        f"Stopped by Ctrl-C {', '.join(f'{delay:g}' for delay in _DELAYS)} seconds after it has begun to read them, it "
        f"ends after at most {max(late):.2f} seconds."
    )
    return max(late) > _LATEST


PARTS = {"pictures": pictures, "noise": noise, "others": others, "whole": whole, "stopped": stopped}


def _cost(path: Path, read: str, side: int = 0) -> dict[str, Any]:
    """What reading a file costs a process of its own."""
    ended = subprocess.run([sys.executable, "-c", _READ, read, path], capture_output=True, text=True, check=False)
    outcome, seconds, memory = ended.stdout.split() if not ended.returncode else (f"exit {ended.returncode}", 0, 0)
    print(path.name, ended.stdout.strip() or ended.stderr[-200:], file=sys.stderr, flush=True)
    size = sum(512 * file.stat().st_blocks for file in (path, *path.rglob("*")))  # on the disk
    return {
        "file": path.name,
        "kB": size / 1000,
        "megapixels": side**2 / 1e6,
        "outcome": outcome,
        "seconds": float(seconds),
        "MiB": float(memory),
    }


def _bombs(folder: Path, only: Sequence[str]) -> list[Path]:
    """The files of `PICTURES`, made if they are not there."""
    for name in only:
        if not (folder / name).exists():
            print(f"making {name} …", file=sys.stderr, flush=True)
            new = PICTURES[name][1](folder / f"new-{name}")
            new.replace(folder / name)
    return [folder / name for name in only]


def _fit(pictures: Sequence[Path], out: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "jaxfit", "fit", *map(str, pictures), "--out", str(out), "--model", "fast68"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def _refused(folders: Sequence[str]) -> str:
    """How many real pictures are refused, and why the first are."""
    paths, why = find_images(folders, recursive=True), []
    for path in paths:
        try:
            read_image(path)
        except ImageError as error:
            why.append(str(error))
    return "\n".join([f"Of {len(paths):,} real pictures, {len(why)} are refused.", *(f"- {line}" for line in why[:20])])


def _encoded(
    channels: int = 3, dtype: type = np.uint8, side: int = _SIDE, noise: bool = False, **options: int
) -> Callable[[Path], Path]:
    """Writes a black picture, or noise, with OpenCV."""

    def write(path: Path) -> Path:
        shape = (side, side) if channels == 1 else (side, side, channels)
        picture: np.ndarray = np.zeros(shape, dtype)
        if noise:
            picture = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype)
        flags = [value for name, number in options.items() for value in (getattr(cv2, f"IMWRITE_{name}"), number)]
        path.write_bytes(cv2.imencode(path.suffix, picture, flags)[1].tobytes())
        return path

    return write


def _png(bits: int, colour: int, channels: int, interlaced: bool = False) -> Callable[[Path], Path]:
    """Writes a PNG of so many bits a channel, as OpenCV writes none."""

    def write(path: Path) -> Path:
        packed, row = zlib.compressobj(1), bytes(1 + _SIDE * bits * channels // 8)
        pixels = b"".join(packed.compress(row) for _ in range(_SIDE + _SIDE // 8 * interlaced)) + packed.flush()
        header = struct.pack(">IIBBBBB", _SIDE, _SIDE, bits, colour, 0, 0, interlaced)
        chunks = ((b"IHDR", header), (b"IDAT", pixels), (b"IEND", b""))
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(map(_chunk, chunks)))
        return path

    return write


def _chunk(part: tuple[bytes, bytes]) -> bytes:
    kind, data = part
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _scans(count: int, side: int) -> Callable[[Path], Path]:
    """Writes a progressive JPEG that goes on with its last scan until there are so many."""

    def write(path: Path) -> Path:
        data = _encoded(side=side, JPEG_PROGRESSIVE=1)(path).read_bytes()
        there, at = data.count(b"\xff\xda"), data.rindex(b"\xff\xda")
        path.write_bytes(data[:-2] + data[at:-2] * (count - there) + data[-2:])
        return path

    return write


def _run_length_bmp(path: Path) -> Path:
    palette = bytes(4 * 256)
    rows = (bytes([255, 0]) * (_SIDE // 255) + bytes([_SIDE % 255, 0, 0, 0])) * _SIDE + bytes([0, 1])
    start = 14 + 40 + len(palette)
    header = struct.pack("<IiiHHIIiiII", 40, _SIDE, _SIDE, 1, 8, 1, len(rows), 0, 0, 256, 0)
    path.write_bytes(b"BM" + struct.pack("<IHHI", start + len(rows), 0, 0, start) + header + palette + rows)
    return path


PICTURES: dict[str, tuple[int, Callable[[Path], Path]]] = {
    "plain.jpg": (_SIDE, _encoded()),
    "progressive.jpg": (_SIDE, _encoded(JPEG_PROGRESSIVE=1)),
    "100-scans.jpg": (4472, _scans(100, 4472)),
    "1-bit.png": (_SIDE, _png(1, 0, 1)),
    "8-bit.png": (_SIDE, _png(8, 2, 3)),
    "16-bit-transparent.png": (_SIDE, _png(16, 6, 4)),
    "16-bit-interlaced.png": (_SIDE, _png(16, 6, 4, interlaced=True)),
    "lossless.webp": (_SIDE, _encoded(WEBP_QUALITY=101)),
    "run-length.bmp": (_SIDE, _run_length_bmp),
    "8-bit.tiff": (_SIDE, _encoded(TIFF_COMPRESSION=8)),
    "16-bit-transparent.tiff": (_SIDE, _encoded(4, np.uint16, TIFF_COMPRESSION=8)),
    "plain.gif": (_SIDE, _encoded()),
    "plain.avif": (_LESS, _encoded(side=_LESS, AVIF_SPEED=10)),
    "12-bit-transparent.avif": (_LESS, _encoded(4, np.uint16, side=_LESS, AVIF_SPEED=10, AVIF_DEPTH=12)),
    "plain.jp2": (_SIDE, _encoded()),
    "transparent.jp2": (11616, _encoded(4, side=11616)),
    "plain.pgm": (_SIDE, _encoded(1)),
    "plain.hdr": (_SIDE, _encoded(3, np.float32)),
    "plain.pfm": (_LESS, _encoded(3, np.float32, side=_LESS)),
    "16-bit.ppm": (_SIDE, _encoded(3, np.uint16)),
    "raw-16-bit-transparent.tiff": (_SIDE, _encoded(4, np.uint16, TIFF_COMPRESSION=1)),
    "plain.sr": (_SIDE, _encoded()),
    "noise.jpg": (_SIDE, _encoded(noise=True, JPEG_PROGRESSIVE=1, JPEG_QUALITY=100)),
    "noise.png": (_SIDE, _encoded(noise=True)),
    "noise.webp": (_SIDE, _encoded(noise=True, WEBP_QUALITY=100)),
    "noise.gif": (_SIDE, _encoded(noise=True)),
    "noise.avif": (_LESS, _encoded(side=_LESS, noise=True, AVIF_SPEED=10, AVIF_QUALITY=86)),
    "noise.jp2": (4380, _encoded(side=4380, noise=True, JPEG2000_COMPRESSION_X1000=1000)),
}


def _matlab(variables: int) -> Callable[[Path], Path]:
    """Writes a ``.mat`` file of compressed zeros, 60 MiB each."""

    def write(path: Path) -> Path:
        packed, size = zlib.compressobj(9), 60 << 20
        parts = [packed.compress(struct.pack("<II", 14, size))]
        parts += [packed.compress(bytes(1 << 20)) for _ in range(size >> 20)]
        content = b"".join([*parts, packed.flush()])
        path.write_bytes(bytes(124) + b"\x00\x01IM" + (struct.pack("<II", 15, len(content)) + content) * variables)
        return path

    return write


def _aflw(fill: str) -> Callable[[Path], Path]:
    """Writes a database like AFLW's, and fills it."""

    def write(path: Path) -> Path:
        (path / "data" / "flickr").mkdir(parents=True)
        with closing(sqlite3.connect(path / "data" / "aflw.sqlite")) as database:
            database.executescript(
                "CREATE TABLE Faces(face_id, file_id); CREATE TABLE FaceImages(file_id, filepath);"
                "CREATE TABLE FaceRect(face_id, x, y, w, h); CREATE TABLE FacePose(face_id, roll, pitch, yaw);"
                "CREATE TABLE FeatureCoords(face_id, feature_id, x, y);"
                "CREATE VIEW Numbers AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 30000) "
                f"SELECT i FROM n; {fill}"
            )
        return path

    return write


def _model(path: Path) -> Path:
    """A model whose file is a terabyte of zeros, which take no room on the disk."""
    with path.open("wb") as file:
        file.truncate(1 << 40)
    return path


def _toml(text: str) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        path.write_text(text[:100_000], encoding="utf-8")
        return path

    return write


OTHERS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "terabyte.jpg": (_PICTURE, _model),
    "terabyte.safetensors": (_MODEL, _model),
    "zeros.mat": (_MATLAB, _matlab(20)),
    "long-keys.toml": (_TOML, _toml("a" + ".a" * 50_000)),
    "deep-lists.toml": (_TOML, _toml("a = " + "[" * 100_000)),
    "many-tables.toml": (_TOML, _toml("".join(f"[a{number:x}]\n" for number in range(20_000)))),
    "large-text": (
        _AFLW,
        _aflw(
            "INSERT INTO Faces VALUES(1, 1); INSERT INTO FaceImages VALUES(1, zeroblob(2000000));"
            "INSERT INTO FeatureCoords VALUES(1, 1, 1, 1)"
        ),
    ),
    "all-faces-in-all-pictures": (
        _AFLW,
        _aflw("INSERT INTO Faces SELECT i, 1 FROM Numbers; INSERT INTO FaceImages SELECT 1, 'a.jpg' FROM Numbers"),
    ),
}


if __name__ == "__main__":
    sys.exit(main())
