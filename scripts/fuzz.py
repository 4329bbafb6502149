"""Feed mutated files and requests to all that reads what others made; report what ends in other than jaxfit's errors.

Each target is tried by processes of its own, so that crashes and hangs are found as well; what was found is kept with
the input that did it, and the same seed makes the same inputs.
"""

import argparse
import contextlib
import csv
import json
import os
import resource
import shutil
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from report import Report, measure, script_parser
from scipy.io import savemat

import jaxfit
from jaxfit.cascade import Greedy
from jaxfit.cli.arguments import out_folder, seed
from jaxfit.cli.main import exit_code
from jaxfit.data.boxes import read_boxes
from jaxfit.data.detectors.whole import Whole
from jaxfit.data.names import pictures_named, table_path
from jaxfit.data.orientations import orientation_of
from jaxfit.data.pictures import decode_image, find_images, write_image
from jaxfit.data.pts import write_pts
from jaxfit.data.videos import Video, write_video
from jaxfit.errors import JaxfitError
from jaxfit.experiments import read_config
from jaxfit.heads.model import load_head_model, save_head_model
from jaxfit.labels.datasets import read_dataset
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.methods import Options
from jaxfit.learning.train import train
from jaxfit.runs import FolderRun, fit_folder
from jaxfit.schemes.known import IBUG68, LFPW29_NAMES
from jaxfit.serving import Server, Service

_LIMIT = 20.0  # seconds for one input
_MEMORY = 8 * 2**30  # bytes that a process may ask for
_READ, _PART, _REFUSED, _FOUND = "read", "read in part", "refused", "finding"
_TOKENS = [b"nan", b"inf", b"-1", b"1e999", b"0", b"9" * 20, b"", b"\0", b"\xff\xfe", b"{}", b"null", b"[[", b"../"]


class Target(NamedTuple):
    """Something that reads: what it reads well, and how to have it read something else."""

    seeds: list[bytes]
    attempt: Callable[[bytes], str]


def main() -> int:
    parser = script_parser(__doc__, out="findings")
    parser.add_argument("--count", type=int, default=20_000, metavar="N", help="inputs in all (default: 20000)")
    parser.add_argument("--only", nargs="+", choices=TARGETS, default=list(TARGETS), help="what to try")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--worker", nargs=2, type=int, metavar=("FIRST", "LAST"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    return exit_code(_work, arguments) if arguments.worker else measure(run, arguments)


def run(arguments: argparse.Namespace, report: Report) -> int:
    out = out_folder(arguments.out)
    each = -(-arguments.count // len(arguments.only))
    rows = []
    for name in arguments.only:
        began = time.monotonic()
        outcomes = _tried(name, each, arguments.seed, out)
        print(f"{name}: {dict(outcomes)}, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        rows.append(
            {"target": name, "inputs": each, **{kind: outcomes[kind] for kind in (_READ, _PART, _REFUSED, _FOUND)}}
        )
    columns = {"target": "", "inputs": "d", _READ: "d", _PART: "d", _REFUSED: "d", _FOUND: "d"}
    total = {key: sum(row[key] for row in rows) for key in columns if key != "target"}
    report.table([*rows, {"target": "all", **total}], columns)
    return 1 if total[_FOUND] else 0


def _tried(name: str, count: int, seed: int, out: Path) -> Counter[str]:
    """How a target took so many inputs; a process that dies or hangs is a finding, and the next goes on after it."""
    outcomes: Counter[str] = Counter()
    first = 0
    while first < count:
        for left in ("now", "outcomes.json"):
            (out / left).unlink(missing_ok=True)
        command = [sys.executable, __file__, "--out", str(out), "--seed", str(seed), "--only", name]
        process = subprocess.Popen([*command, "--worker", str(first), str(count)], stderr=subprocess.DEVNULL)
        while process.poll() is None:
            time.sleep(0.1)
            if (now := out / "now").exists() and time.time() - now.stat().st_mtime > 2 * _LIMIT:
                process.kill()
                process.wait()
        counted = json.loads((out / "outcomes.json").read_text()) if (out / "outcomes.json").exists() else {}
        outcomes.update(counted)
        first += sum(counted.values())
        if process.returncode != 0 and first < count:
            if not (out / "now").exists():
                raise RuntimeError(f"{name}: the process could not begin")
            outcomes[_FOUND] += 1
            shutil.move(out / "now", out / f"{name}-{first:06}.crash")
            first += 1
    return outcomes


def _work(arguments: argparse.Namespace) -> int:
    """Try some inputs; how each ended is written at once."""
    name, (first, last), out = arguments.only[0], arguments.worker, Path(arguments.out)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        target = TARGETS[name](Path(folder))
        for data in target.seeds:
            if target.attempt(data) != _READ:
                raise RuntimeError(f"{name}: a seed is not read")
        outcomes: Counter[str] = Counter()
        for number in range(first, last):
            data = mutated(target.seeds, np.random.default_rng([arguments.seed, number]))
            (out / "now").write_bytes(data)
            began = time.monotonic()
            try:
                outcome = target.attempt(data)
            except JaxfitError:
                outcome = _REFUSED
            except Exception:
                outcome = _FOUND
                (out / f"{name}-{number:06}.txt").write_text(traceback.format_exc())
            if time.monotonic() - began > _LIMIT:
                outcome = _FOUND
            if outcome == _FOUND:
                shutil.copy(out / "now", out / f"{name}-{number:06}.input")
            outcomes[outcome] += 1
            (out / "outcomes.tmp").write_text(json.dumps(outcomes))
            (out / "outcomes.tmp").replace(out / "outcomes.json")
    return 0


def mutated(seeds: list[bytes], rng: np.random.Generator) -> bytes:
    """One of some inputs, changed in one to three places."""
    data = bytearray(seeds[rng.integers(len(seeds))])
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(data) + 1))
        # Headers say more than what follows.
        at = at if rng.random() < 0.5 else min(at, int(rng.integers(1, 257)))
        length = min(2 ** int(rng.integers(0, 12)), len(data) - at)
        match rng.integers(8):
            case 0 if at < len(data):
                data[at] ^= 1 << int(rng.integers(8))
            case 1 if at < len(data):
                data[at] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFF]))
            case 2:
                data = data[:at] if rng.random() < 0.3 else data
            case 3:
                del data[at : at + length]
            case 4:
                data[at:at] = data[at : at + length]
            case 5:
                other = seeds[rng.integers(len(seeds))]
                start = int(rng.integers(len(other) + 1))
                data[at : at + length] = other[start : start + length]
            case 6:
                data[at : at + int(rng.integers(4))] = _TOKENS[rng.integers(len(_TOKENS))]
            case _:
                data[at : at + length] = rng.bytes(length)
    return bytes(data)


def _picture() -> np.ndarray:
    x, y = np.meshgrid(np.arange(64), np.arange(48))
    return np.stack([4 * x, 5 * y, 2 * (x + y)], -1).clip(0, 255).astype(np.uint8)


def _points() -> np.ndarray:
    return np.random.default_rng(1).uniform(8, 40, (68, 2))


def _images(_: Path) -> Target:
    usual = (_picture(), _picture()[..., 0])
    more = (np.dstack([_picture(), _picture()[..., 0]]), _picture().astype(np.uint16) * 257)
    pictures = {".jpg": usual, ".png": usual + more, ".bmp": usual, ".tif": usual + more, ".webp": usual}
    seeds = [cv2.imencode(suffix, each)[1].tobytes() for suffix, some in pictures.items() for each in some]
    exif = bytes.fromhex("ffe10022457869660000") + b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    seeds.append(seeds[0][:2] + exif + seeds[0][2:])

    def attempt(data: bytes) -> str:
        decode_image(data)
        return _READ

    return Target(seeds, attempt)


def _dataset(folder: Path, spec: str, changed: Path) -> Callable[[bytes], str]:
    def attempt(data: bytes) -> str:
        changed.write_bytes(data)
        return _PART if read_dataset(spec).problems else _READ

    return attempt


def _exif(_: Path) -> Target:
    """EXIF data, in a picture of each format that has some."""
    orientation = b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0"
    big = b"MM\0*\0\0\0\x08\0\x01" + orientation + b"\0\0\0\0"
    little = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x08\0\0\0\0\0\0\0"
    jpeg, png, webp = (cv2.imencode(suffix, _picture())[1].tobytes() for suffix in (".jpg", ".png", ".webp"))

    def attempt(data: bytes) -> str:
        block = b"eXIf" + data
        chunk = len(data).to_bytes(4) + block + zlib.crc32(block).to_bytes(4)
        segment = b"\xff\xe1" + min(len(data) + 8, 0xFFFF).to_bytes(2) + b"Exif\0\0" + data
        riff = webp[8:] + b"EXIF" + len(data).to_bytes(4, "little") + data + b"\0" * (len(data) % 2)
        files = (jpeg[:2] + segment + jpeg[2:], png[:33] + chunk + png[33:])
        for picture in (*files, b"RIFF" + len(riff).to_bytes(4, "little") + riff):
            orientation_of(picture)
            decode_image(picture)
        orientation_of(data)
        return _READ

    return Target([big, little], attempt)


def _names(folder: Path) -> Target:
    """Names of pictures, with their boxes: a run over them has a row for each, and tables that anybody reads."""
    model = folder / "small.safetensors"
    jaxfit.save(_small_model(folder), model)
    picture = cv2.imencode(".png", _picture())[1].tobytes()

    def attempt(data: bytes) -> str:
        names = dict.fromkeys(part[:255] for part in data.replace(b"/", b"").split(b"\0"))
        run = Path(tempfile.mkdtemp(dir=folder))
        pictures = []
        for name in names:
            path = run / os.fsdecode(name)
            if name in (b"", b".", b".."):
                continue
            path.write_bytes(picture)
            pictures.append(path)
        if not pictures:
            return _REFUSED
        try:
            with (run / "_.csv").open("w", newline="", encoding="utf-8") as file:
                rows = csv.writer(file)
                rows.writerow(["image", "x", "y", "width", "height"])
                rows.writerows([table_path(path), 8, 8, 32, 32] for path in pictures)
            how = FolderRun(out=run / "out", model=model, boxes=run / "_.csv", formats=("csv", "pts", "jsonl", "coco"))
            report = fit_folder(how, pictures)
            with (run / "out" / "landmarks.csv").open(newline="", encoding="utf-8") as file:
                spelled = [row["image"] for row in csv.DictReader(file)]
            found = pictures_named(spelled, pictures)
            if sorted(path for each in found.values() for path in each) != sorted(pictures):
                raise RuntimeError(f"{spelled} are not the names of {pictures}")
            json.loads((run / "out" / "keypoints.json").read_text(encoding="utf-8"))
            return _PART if report.problems else _READ
        finally:
            shutil.rmtree(run)

    seeds = [b"a.png\0b.png", "é.jpg\0e\u0301.png\0Z.png\0z.png".encode(), b"=1.png\0-x\0\xe9 .png\0a\nb", b"x" * 255]
    return Target(seeds, attempt)


def _folders(folder: Path) -> Target:
    """Trees of files, folders and links, and patterns over them: all is read or reported."""
    picture = cv2.imencode(".png", _picture())[1].tobytes()

    def attempt(data: bytes) -> str:
        root = Path(tempfile.mkdtemp(dir=folder))
        places = [root]
        pattern = "*"
        try:
            for step in data.split(b"\n")[:12]:
                kind, name = step[:1], os.fsdecode(step[1:60].replace(b"/", b"").replace(b"\0", b""))
                path = places[len(name) % len(places)] / name
                with contextlib.suppress(OSError):  # a name that is there, or none
                    match kind:
                        case b"d":
                            path.mkdir()
                            places.append(path)
                        case b"l":
                            path.symlink_to(places[-1])
                        case b"b":
                            path.symlink_to(name + "?")
                        case b"e":
                            path.touch()
                        case b"g":
                            pattern = name or "*"
                        case b"t":
                            path.write_bytes(step)
                        case _:
                            path.write_bytes(picture)
            found = []
            for paths in ([root], [root / pattern], [root / "**" / pattern]):
                with contextlib.suppress(JaxfitError):
                    found += find_images(paths, recursive=True)
            problems = 0
            for path in found:
                try:
                    jaxfit.read_image(path)
                except JaxfitError:
                    problems += 1
            return _REFUSED if not found else _PART if problems else _READ
        finally:
            shutil.rmtree(root)

    return Target([b"fa.png\nfb.png\nddeep\nfcc.png\nlround\ng*.png", b"fab\ndd\nfabcd\ng[a-z]*"], attempt)


def _arrays(folder: Path) -> Target:
    """Arrays of any type, shape and layout as pictures, and any numbers as their boxes."""
    model = _small_model(folder)
    kinds = [
        "u1",
        "u2",
        "u4",
        "i1",
        "i2",
        "i8",
        "f2",
        "f4",
        "f8",
        "c8",
        "?",
        "S3",
        "U2",
        "M8[s]",
        "m8[s]",
        "V5",
        ">u2",
        ">f4",
    ]

    def attempt(data: bytes) -> str:
        head, rest = data[:12].ljust(12, b"\0"), data[12:]
        kind = np.dtype(kinds[head[0] % len(kinds)])
        shape = tuple(size % 70 for size in head[2 : 2 + head[1] % 5])
        size = int(np.prod(shape)) * kind.itemsize
        array = np.frombuffer(np.resize(np.frombuffer(rest or b"\0", np.uint8), size).tobytes(), kind).reshape(shape)
        array = array[::-1] if array.ndim and head[7] & 1 else array
        array = array.T if head[7] & 2 else array
        boxes = np.frombuffer(rest[:32].ljust(32, b"\0"), np.float64) if head[8] & 1 else np.array([2.0, 2, 30, 30])
        boxes = boxes.reshape((1, 4) if head[8] & 6 else (4,))
        with np.errstate(all="ignore"):
            _, problems = jaxfit.crop_faces(model, array if head[9] & 1 else [array], boxes)
        return _PART if problems else _READ

    grey, colour = bytes([0, 2, 48, 64, 0, 0, 0, 0, 2, 0, 0, 0]), bytes([0, 3, 48, 64, 3, 0, 0, 0, 2, 0, 0, 0])
    wide = bytes([1, 2, 40, 60, 0, 0, 0, 1, 2, 0, 0, 0])
    return Target([head + _picture().tobytes()[:40] for head in (grey, colour, wide)], attempt)


def _pts(folder: Path) -> Target:
    for name in ("a", "b"):
        write_image(folder / f"{name}.png", _picture())
        write_pts(folder / f"{name}.pts", _points())
    seed = (folder / "a.pts").read_bytes()
    return Target([seed], _dataset(folder, f"pts:{folder}", folder / "b.pts"))


def _aflw(folder: Path) -> Target:
    (folder / "flickr").mkdir()
    write_image(folder / "flickr" / "f.jpg", _picture())
    path = folder / "aflw.sqlite"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE Faces (face_id, file_id)")
        database.execute("CREATE TABLE FaceImages (file_id, filepath)")
        database.execute("CREATE TABLE FaceRect (face_id, x, y, w, h)")
        database.execute("CREATE TABLE FacePose (face_id, roll, pitch, yaw)")
        database.execute("CREATE TABLE FeatureCoords (face_id, feature_id, x, y)")
        database.execute("INSERT INTO FaceImages VALUES ('f', 'f.jpg')")
        for face in range(1, 4):
            database.execute("INSERT INTO Faces VALUES (?, 'f')", (face,))
            database.execute("INSERT INTO FaceRect VALUES (?, 1, 2, 30, 30)", (face,))
            database.execute("INSERT INTO FacePose VALUES (?, 0.1, 0.2, -0.3)", (face,))
            rows = [(face, number, *map(float, point)) for number, point in enumerate(_points()[:21], 1)]
            database.executemany("INSERT INTO FeatureCoords VALUES (?, ?, ?, ?)", rows)
    return Target([path.read_bytes()], _dataset(folder, f"aflw:{folder}", path))


def _lfpw(folder: Path) -> Target:
    write_image(folder / "a.png", _picture())
    header = ["imgurl", "worker", *(f"{name}_{part}" for name in LFPW29_NAMES for part in "xyt")]
    row = ["a.png", "average", *(text for x, y in _points()[:29] for text in (f"{x:.1f}", f"{y:.1f}", "0"))]
    path = folder / "labels.csv"
    text = "\t".join(header) + "\n" + ("\t".join(row) + "\n") * 2
    return Target([text.encode()], _dataset(folder, f"lfpw:{path}", path))


def _pointing04(folder: Path) -> Target:
    person = folder / "Person01"
    person.mkdir()
    for name in ("person01146+0+0", "person01147+0+15"):
        write_image(person / f"{name}.jpg", _picture())
        (person / f"{name}.txt").write_text(f"{name}.jpg\n\nFace\n30\n20\n18\n20\n")
    path = person / "person01147+0+15.txt"
    return Target([path.read_bytes()], _dataset(folder, f"pointing04:{folder}", path))


def _aflw2000(folder: Path) -> Target:
    for name in ("a", "b"):
        write_image(folder / f"{name}.jpg", _picture())
        points = np.vstack([_points().T, np.zeros(68)])
        savemat(
            folder / f"{name}.mat", {"Pose_Para": np.full((1, 7), 0.1), "pt3d_68": points}, do_compression=name == "b"
        )
    seeds = [(folder / f"{name}.mat").read_bytes() for name in ("a", "b")]
    return Target(seeds, _dataset(folder, f"aflw2000:{folder}", folder / "b.mat"))


def _file(path: Path, read: Callable[[Path], object], *seeds: bytes) -> Target:
    """A file that is read from a path, with these contents, or, without, with those that it has."""

    def attempt(data: bytes) -> str:
        path.write_bytes(data)
        read(path)
        return _READ

    return Target([*seeds] or [path.read_bytes()], attempt)


def _boxes(folder: Path) -> Target:
    numbers = b"image,x,y,width,height\na.png,1,2,30,40\nb.png,5.5,6,7,8\n"
    return _file(folder / "boxes.csv", read_boxes, numbers, b'width,height,x,y,image\r\n9,9,1,1,"a, b.png"\r\n')


def _small_model(folder: Path) -> jaxfit.Model:
    """Of three landmarks' worth of training: quick to make and to read."""
    faces = []
    for number in range(6):
        picture = np.random.default_rng(number).integers(0, 255, (120, 120), dtype=np.uint8)
        write_image(folder / f"face{number}.png", picture)
        points = 30 + 1.2 * _points() + np.random.default_rng(number).normal(0, 1, (68, 2))
        present = np.ones(68, bool)
        faces.append(
            FaceRecord(folder / f"face{number}.png", points, present, present, None, None, str(number), str(number))
        )
    options = Options(greedy=Greedy(windows=(0.3,), augmentations=1, rank=2), detectors=False)
    return train(faces, IBUG68, options=options).model


def _models(folder: Path) -> Target:
    path = folder / "model.safetensors"
    jaxfit.save(_small_model(folder), path)
    return _file(path, jaxfit.load)


def _heads(folder: Path) -> Target:
    path = folder / "head.safetensors"
    save_head_model(load_head_model(), path)
    return _file(path, lambda path: load_head_model(path).of(IBUG68, 0.5))


def _configs(folder: Path) -> Target:
    text = (
        b"folds = 2\naugmentations = [1, 5]\n[chosen]\naugmentations = 5\n[training]\nwindows = [0.4, 0.3]\n"
        b'[datasets.f]\ndata = ["pts:f"]\n[methods.sdm]\n'
    )
    return _file(folder / "config.toml", read_config, text)


def _videos(folder: Path) -> Target:
    films = [folder / f"film{suffix}" for suffix in (".mp4", ".webm")]
    for path in films:
        with write_video(path, 25.0) as write:
            for number in range(5):
                write(np.roll(_picture(), number, 1))
    films.append(folder / "film.avi")
    writer = cv2.VideoWriter(str(films[-1]), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for _ in range(5):
        writer.write(_picture())
    writer.release()
    changed = folder / "changed.mkv"

    def attempt(data: bytes) -> str:
        changed.write_bytes(data)
        with Video(changed) as video:
            for _ in video:
                pass
            return _PART if video.problem else _READ

    return Target([path.read_bytes() for path in films], attempt)


def _page(folder: Path) -> Target:
    """Requests to the page's server; it has to go on answering."""
    server = Server(Service({"small": _small_model(folder)}, {"whole": Whole()}), seconds=1.0)
    threading.Thread(target=server.serve_forever, daemon=True).start()

    def request(body: bytes, kind: str) -> bytes:
        lines = (
            "POST /fit?model=small&detector=whole HTTP/1.1",
            f"Host: 127.0.0.1:{server.port}",
            f"Content-Type: image/{kind}",
            f"Content-Length: {len(body)}",
            "X-Jaxfit: 1",
            "Connection: close",
        )
        return "\r\n".join(lines).encode() + b"\r\n\r\n" + body

    def answer(data: bytes) -> bytes:
        with socket.create_connection(("127.0.0.1", server.port), timeout=_LIMIT) as client:
            try:
                client.sendall(data)
                client.shutdown(socket.SHUT_WR)
                return client.recv(1 << 16)
            except OSError:  # refused while it was sending
                return b""

    pictures = {kind: cv2.imencode(f".{kind}", _picture())[1].tobytes() for kind in ("png", "jpeg", "webp", "bmp")}
    whole = [request(picture, kind) for kind, picture in pictures.items()]
    bodies = list(pictures.values())

    def attempt(data: bytes) -> str:
        # Half of the inputs are mangled requests, the others proper ones of mangled pictures.
        if (data not in whole and data[:4] != b"POST") or data in bodies:
            data = request(data, "png")
        status = answer(data)[9:12]
        if status.startswith(b"5") and status not in (b"501", b"503", b"505"):
            raise RuntimeError(f"status {status!r}")
        if answer(whole[0])[9:12] != b"200":
            raise RuntimeError(f"no answer to a good request any more, after {status!r}")
        return _READ if status == b"200" else _REFUSED

    return Target([*whole, *bodies], attempt)


TARGETS: dict[str, Callable[[Path], Target]] = {
    "images": _images,
    "exif": _exif,
    "names": _names,
    "folders": _folders,
    "arrays": _arrays,
    "pts": _pts,
    "aflw": _aflw,
    "lfpw": _lfpw,
    "pointing04": _pointing04,
    "aflw2000": _aflw2000,
    "boxes": _boxes,
    "models": _models,
    "heads": _heads,
    "configs": _configs,
    "videos": _videos,
    "page": _page,
}

if __name__ == "__main__":
    sys.exit(main())
