"""Compare models with other programs, in environments of their own, on the same pictures: ``docs/measured/rivals.md``.

In ``--environments`` a virtual environment is made for each of dlib and MediaPipe, from the package index, unless it is
there. They look for faces themselves, as models do with ``--detector``; dlib's predictor also fits in the boxes that
dlib's detector would draw around the labels, moved and scaled as those that models start from without ``--detector``.
Fits of other programs join with ``--fits NAME=FILE``.
"""

import argparse
import csv
import json
import subprocess
import sys
import venv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from report import Report, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.compare import plan_comparison, read_contestants
from jaxfit.evaluation.datasets import EvaluationRun
from jaxfit.experiments.comparison import comparison_tables
from jaxfit.fitting.pipeline import Fitting
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import FaceRecord
from jaxfit.models.model import SQUARE

SCRIPTS = Path(__file__).resolve().parent / "rival_programs"
PINS = {
    "dlib": ("dlib-bin==20.0.1.post1", "opencv-python-headless==4.12.0.88", "face-recognition-models==0.3.0"),
    "mediapipe": ("mediapipe==0.10.21",),
}
PREDICTOR = "shape_predictor_68_face_landmarks.dat"
DETECTED, IN_BOXES = "found by each program", "in boxes around the labels"


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("models", nargs="+", metavar="MODEL", help="bundled models' names or model files")
    add_datasets(parser)
    parser.add_argument("--fits", nargs="+", default=[], metavar="NAME=FILE", help="fits of other programs")
    parser.add_argument("--detector", default="yunet", help="that finds the faces for models (default: yunet)")
    parser.add_argument("--environments", required=True, metavar="DIR", help="where environments and tables go")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    folder = Path(arguments.environments)
    folder.mkdir(parents=True, exist_ok=True)
    datasets = read_datasets(arguments.data, arguments.scheme)
    faces = [face for dataset in datasets for face in dataset.faces]
    pictures = folder / "pictures.txt"
    pictures.write_text("\n".join(dict.fromkeys(str(face.image) for face in faces)), encoding="utf-8")
    python = {name: environment(folder / name, pins) for name, pins in PINS.items()}
    predictor = next((folder / "dlib").rglob(PREDICTOR))
    boxes = write_boxes(folder / "boxes.csv", faces)
    took = {
        "dlib": ran(python["dlib"], "dlib_fits.py", pictures, folder / "dlib.csv", predictor),
        "mediapipe": ran(python["mediapipe"], "mediapipe_fits.py", pictures, folder / "mediapipe.csv"),
        "dlib in boxes": ran(python["dlib"], "dlib_fits.py", pictures, folder / "dlib-boxes.csv", predictor, boxes),
    }
    found = [f"dlib={folder / 'dlib.csv'}", f"mediapipe={folder / 'mediapipe.csv'}", *arguments.fits]
    compared(report, arguments, DETECTED, [*arguments.models, *found], Fitting(arguments.detector))
    compared(report, arguments, IN_BOXES, [*arguments.models, f"dlib={folder / 'dlib-boxes.csv'}"], Fitting())
    sizes = {"dlib": predictor.stat().st_size, "mediapipe": sum(size_of(folder / "mediapipe", "face_*.tflite"))}
    rows = [
        {
            "program": f"{name} {of['version']}",
            "ms/picture": 1000 * of["seconds"] / of["pictures"],
            "memory, MB": of["megabytes"],
            "models, MB": sizes[name.split()[0]] / 1e6,
        }
        for name, of in took.items()
    ]
    columns = {"program": "", "ms/picture": ".1f", "memory, MB": ".0f", "models, MB": ".1f"}
    report.table(rows, columns, above="## Time, memory and size\n\nFinding and fitting, pictures read; of one process.")


def environment(folder: Path, pins: Sequence[str]) -> Path:
    """The Python of an environment with these packages, made if it is not there."""
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
        subprocess.run([str(python), "-m", "pip", "install", "--quiet", *pins], check=True)
    return python


def ran(python: Path, script: str, *arguments: Path) -> dict[str, Any]:
    """What a program says that it took; its table is made once."""
    said = arguments[1].with_suffix(".json")
    if not (said.exists() and arguments[1].exists()):
        command = [str(python), str(SCRIPTS / script), *map(str, arguments)]
        ended = subprocess.run(command, check=False, capture_output=True, text=True)
        if ended.returncode:
            raise InputError(f"{script}: expected fits; it ended with {ended.returncode}: {ended.stderr[-300:]}")
        said.write_text(ended.stdout.splitlines()[-1], encoding="utf-8")
    return dict(json.loads(said.read_text(encoding="utf-8")))


def write_boxes(path: Path, faces: Sequence[FaceRecord]) -> Path:
    """Boxes as dlib's detector would draw them around the labels, from where models start without a detector."""
    model = jaxfit.load()
    square, drawn = model.placement(SQUARE), model.placement("dlib")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "x", "y", "width", "height"])
        for face, start in zip(faces, start_boxes(faces), strict=True):
            if np.isnan(start).any():
                continue
            centre, size = square.face_in(start)
            side = size / np.exp(drawn.log_scale)
            corner = centre - side * np.array(drawn.shift) - side / 2
            writer.writerow([str(face.image), *corner, side, side])
    return path


def compared(
    report: Report, arguments: argparse.Namespace, title: str, contestants: Sequence[str], fitting: Fitting
) -> None:
    """Add the tables of a comparison."""
    run = EvaluationRun(fitting, scheme=arguments.scheme)
    plan = plan_comparison(read_contestants(contestants), arguments.data, run)
    tables = {table.name: table for table in comparison_tables(plan.compare())}
    report.add(f"## Faces {title}", *(f"- {note}" for note in plan.notes))
    for name in ("errors", "tests", "by-yaw", "poses", "pose-tests"):
        if name in tables:
            report.table(tables[name].rows, tables[name].columns, above=f"### {tables[name].title}")
            report.add(tables[name].note)


def size_of(folder: Path, pattern: str) -> list[int]:
    """The sizes of the files of a pattern in a folder, in bytes."""
    return [path.stat().st_size for path in folder.rglob(pattern)]


if __name__ == "__main__":
    sys.exit(main())
