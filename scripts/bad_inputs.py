"""Try every kind of bad input and print what a user sees, as a table."""

import argparse
import contextlib
import io
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike
from report import Report, measure, script_parser
from safetensors.numpy import load_file, save_file
from scipy.io import savemat

import jaxfit
from jaxfit.cli.main import main as command
from jaxfit.data.pictures import write_image
from jaxfit.data.pts import write_pts


def main() -> int:
    return measure(run, script_parser(__doc__).parse_args())


def run(_: argparse.Namespace, report: Report) -> None:
    with tempfile.TemporaryDirectory() as name:
        rows = [
            {"input": what, "what the user sees": attempt().strip().replace(name, "…").replace("\n", "<br>")}
            for what, attempt in cases(Path(name)).items()
        ]
    report.table(rows, {"input": "", "what the user sees": ""})


def cases(folder: Path) -> dict[str, Callable[[], str]]:
    """Each bad input with a function that tries it and returns what was said."""
    model = jaxfit.load("sdm68")
    portrait = _portrait(folder)
    picture = jaxfit.read_image(portrait)
    box = jaxfit.detect_faces(picture, "haar")[0].box
    points = jaxfit.fit(model, [picture], [box], kind="haar-frontal").landmarks[0]

    def made(name: str, content: bytes) -> Path:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return path

    def fits(path: Path) -> Callable[[], str]:
        return lambda: _said("fit", str(path), "--out", str(folder / "out"))

    def in_python(images: list[np.ndarray], boxes: ArrayLike) -> Callable[[], str]:
        def attempt() -> str:
            try:
                fitted = jaxfit.fit(model, images, boxes, kind="haar-frontal")
            except jaxfit.JaxfitError as error:
                return f"{type(error).__name__}: {error}"
            return f"problem: {fitted.problems[0]}" if fitted.problems else "fitted like any other"

        return attempt

    jpeg = portrait.read_bytes()
    grey = picture.mean(2).astype(np.uint8)
    alpha = np.concatenate([picture, np.full((*grey.shape, 1), 200, np.uint8)], 2)
    deep = picture.astype(np.uint16) * 257
    _, deep_png = cv2.imencode(".png", deep)
    _, alpha_png = cv2.imencode(".png", alpha)
    _, flat_png = cv2.imencode(".png", np.zeros((200, 200), np.uint8))

    labels = folder / "labels"
    labels.mkdir()
    for number in range(3):
        write_image(labels / f"face{number:03}.png", picture)
        write_pts(labels / f"face{number:03}.pts", points)
    few = shutil.copytree(labels, folder / "few")
    write_pts(few / "face001.pts", points[:60])
    alone = shutil.copytree(labels, folder / "alone")
    (alone / "face001.png").unlink()
    empty = folder / "empty"
    empty.mkdir()
    boxes = made("boxes.csv", b"image,x,y,width\na.png,1,2,3\n")
    good = made("good.csv", b"image,x,y,width,height\nface000.png,170,100,200,200\n")
    nan = made("nan.csv", b"image,x,y,width,height\nface000.png,nan,100,200,200\n")
    words = made("words.csv", b"image,x,y,width,height\na.png,1,2,3,wide\n")

    bundled = Path(jaxfit.__file__).parent / "models" / "bundled" / "sdm68.safetensors"
    cut = made("cut.safetensors", bundled.read_bytes()[:5000])
    other = folder / "other.safetensors"
    save_file(load_file(bundled), other)
    newer = made("newer.safetensors", bundled.read_bytes().replace(b'\\"format\\": 1,', b'\\"format\\": 9,'))

    def evaluates(model: object, data: object, *more: str) -> Callable[[], str]:
        return lambda: _said("evaluate", str(model), "--data", str(data), "--out", str(folder / "evaluated"), *more)

    return {
        "picture: not a picture": fits(made("text.jpg", b"hello")),
        "picture: empty file": fits(made("nothing.png", b"")),
        "picture: truncated JPEG": fits(made("cut.jpg", jpeg[: len(jpeg) // 2])),
        "picture: HEIC": fits(made("phone.heic", b"\0\0\0\x18ftypheic" + bytes(64))),
        "picture: missing": fits(folder / "nowhere.jpg"),
        "picture: no face in it": fits(made("flat.png", flat_png.tobytes())),
        "picture file: 16 bits": fits(made("deep.png", deep_png.tobytes())),
        "picture file: alpha": fits(made("alpha.png", alpha_png.tobytes())),
        "folder without pictures": fits(empty),
        "array: grey": in_python([grey], [box]),
        "array: RGBA": in_python([alpha], [box]),
        "array: 16 bits": in_python([deep], [box]),
        "array: float": in_python([picture / 255.0], [box]),
        "array: no pixels": in_python([picture[:0]], [box]),
        "box: NaN": in_python([picture], [[np.nan, 0, 10, 10]]),
        "box: no area": in_python([picture], [[10, 10, 0, 10]]),
        "box: outside the picture": in_python([picture], [[9000, 10, 50, 50]]),
        "boxes: wrong shape": in_python([picture], [10, 10, 50, 50]),
        "boxes: a column is missing": evaluates("sdm68", f"pts:{labels}", "--boxes", str(boxes)),
        "boxes: not a number": evaluates("sdm68", f"pts:{labels}", "--boxes", str(words)),
        "boxes: of an unknown kind": evaluates("sdm68", f"pts:{labels}", "--boxes", str(good), "--box-kind", "mine"),
        "boxes: a kind, but no file": evaluates("sdm68", f"pts:{labels}", "--box-kind", "haar-frontal"),
        "boxes: not finite": evaluates("sdm68", f"pts:{labels}", "--boxes", str(nan)),
        "boxes: none for a labelled face": evaluates("sdm68", f"pts:{labels}", "--boxes", str(good)),
        "seed: negative": evaluates("sdm68", f"pts:{labels}", "--seed", "-1"),
        "out: a file, not a folder": lambda: _said("evaluate", "sdm68", "--data", f"pts:{labels}", "--out", str(cut)),
        "training: an option out of range": lambda: _said(
            "train", "--data", f"pts:{labels}", "--variance", "2", "--out", str(folder / "m.safetensors")
        ),
        "labels: wrong number of points in one file": evaluates("sdm68", f"pts:{few}"),
        "labels: a picture is missing": evaluates("sdm68", f"pts:{alone}"),
        "labels: another scheme than the model's": _other_scheme(folder, picture, points),
        "labels: empty folder": evaluates("sdm68", f"pts:{empty}"),
        "labels: no such folder": evaluates("sdm68", f"pts:{folder / 'nowhere'}"),
        "labels: no format named": evaluates("sdm68", labels),
        "labels: AFLW without its database": evaluates("sdm68", f"aflw:{empty}"),
        "model: no such file": evaluates("nothing", f"pts:{labels}"),
        "model: truncated": evaluates(cut, f"pts:{labels}"),
        "model: a safetensors file of something else": evaluates(other, f"pts:{labels}"),
        "model: of another format version": evaluates(newer, f"pts:{labels}"),
        **_of_3d(folder, picture, points, labels, evaluates),
    }


def _of_3d(
    folder: Path, picture: np.ndarray, points: np.ndarray, labels: Path, evaluates: Callable[..., Callable[[], str]]
) -> dict[str, Callable[[], str]]:
    """What can be wrong with heads, their poses and the data sets that have them."""
    mats, people = folder / "mats", folder / "people" / "Person01"
    mats.mkdir()
    people.mkdir(parents=True)
    for name in ("good", "torn"):
        write_image(mats / f"{name}.jpg", picture)
        savemat(
            mats / f"{name}.mat", {"Pose_Para": np.zeros((1, 7)), "pt3d_68": np.vstack([points.T + 1, np.zeros(68)])}
        )
    torn = mats / "torn.mat"
    torn.write_bytes(torn.read_bytes()[:200])
    for tilt in ("+0", "+30"):
        write_image(people / f"person01100{tilt}+0.jpg", picture)
    (people / "person01100+0+0.txt").write_text("person01100+0+0.jpg\nFace\n170\n100\n200\n200\n")
    head = folder / "head.safetensors"
    bundled = Path(jaxfit.__file__).parent / "heads" / "bundled" / "ict-facekit.safetensors"
    head.write_bytes(bundled.read_bytes()[:900])
    train = ("train", "--method", "regression3d", "--out", str(folder / "m.safetensors"))
    return {
        "3D: to refine a 2D model": evaluates("sdm68", f"pts:{labels}", "--refine"),
        "3D: a damaged head model": lambda: _said(*train, "--data", f"pts:{labels}", "--head-model", str(head)),
        "3D: no such head model": lambda: _said(*train, "--data", f"pts:{labels}", "--head-model", "nobody"),
        "3D: AFLW2000 with a damaged file": evaluates("regression68-3d", f"aflw2000:{mats}"),
        "3D: Pointing'04 with a missing box": evaluates("regression68-3d", f"pointing04:{people.parent}"),
        "3D: training without landmarks": lambda: _said(*train, "--data", f"pointing04:{people.parent}"),
    }


def _other_scheme(folder: Path, picture: np.ndarray, points: np.ndarray) -> Callable[[], str]:
    labels = folder / "other-scheme"
    labels.mkdir()
    write_image(labels / "face.png", picture)
    write_pts(labels / "face.pts", points[:29])
    return lambda: _said("evaluate", "sdm68", "--data", f"pts:{labels}", "--out", str(folder / "evaluated"))


def _portrait(folder: Path) -> Path:
    import matplotlib.cbook

    path = folder / "portrait.jpg"
    shutil.copy(matplotlib.cbook.get_sample_data("grace_hopper.jpg", asfileobj=False), path)
    return path


def _said(*arguments: str) -> str:
    """What the command prints, without progress and the tables of what went well, and its exit code."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code: int | str | None = command(arguments)
        except SystemExit as wrong:  # of argparse
            return f"{err.getvalue()}exit code {wrong.code}"
    complaints = [line for line in err.getvalue().splitlines() if not line.endswith("…")]
    first = out.getvalue().splitlines()[:1] if arguments[0] == "fit" else []
    return "\n".join([*complaints, *first, f"exit code {code}"])


if __name__ == "__main__":
    sys.exit(main())
