"""How well turned faces are found: NMED against the rotation, for several numbers of initialisations (Fig. 14).

Each method is trained on all folds but the first, for the largest number of initialisations, and tested on pictures of
the first, turned about the face; or finished models are tested on all pictures. A killed run goes on where it was:
trained models and tables are kept in ``--out``.
"""

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from report import Report, dataset_names, measure, save_figure, script_parser

import jaxfit
from jaxfit.cascade.fit import centroid, fit_starts
from jaxfit.cascade.model import Cascade
from jaxfit.cascade.starts import Starts, starts_of
from jaxfit.cli.arguments import add_datasets, add_training, out_folder, training_options
from jaxfit.cli.progress import Bars
from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.outputs import require_same_settings, write_csv
from jaxfit.data.pictures import read_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.plots import new_figure
from jaxfit.labels.datasets import read_datasets, shared_scheme
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.methods import METHODS
from jaxfit.learning.train import train
from jaxfit.schemes.conversions import convert
from jaxfit.schemes.scheme import Scheme

COUNTS = (1, 3, 5, 7, 9, 11)


def main() -> int:
    parser = script_parser(__doc__, out="models, tables and the figure")
    add_datasets(parser)
    parser.add_argument("--method", nargs="+", choices=METHODS, default=["sdm", "parametric"], help="what to train")
    add_training(parser)
    parser.add_argument("--model", nargs="+", default=[], help="test these, on all faces, instead of training")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument(
        "--degrees",
        type=float,
        nargs="+",
        default=[float(degrees) for degrees in range(-90, 91, 15)],
        help="of the pictures",
    )
    parser.add_argument("--faces", type=int, help="test at most so many faces of each dataset")
    parser.set_defaults(starts=max(COUNTS))
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    datasets = read_datasets(arguments.data, arguments.scheme)
    scheme = shared_scheme(datasets)
    folder = out_folder(arguments.out)
    settings = {k: v for k, v in sorted(vars(arguments).items()) if k not in ("out", "data", "method", "model")}
    settings["datasets"] = names = dataset_names(datasets)
    require_same_settings(folder / "settings.json", settings)
    learned: list[FaceRecord] = []
    tested: dict[str, list[FaceRecord]] = {}
    for name, dataset in zip(names, datasets, strict=True):
        faces = [face for face in dataset.faces if face.complete]
        folds = split_by_subject([face.subject for face in faces], arguments.folds, arguments.seed)
        learned += [face for face, fold in zip(faces, folds, strict=True) if fold > 0 and not arguments.model]
        tested[name] = [face for face, fold in zip(faces, folds, strict=True) if fold == 0 or arguments.model]
        tested[name] = tested[name][: arguments.faces]
    rows: list[dict[str, Any]] = []
    for method in arguments.model or arguments.method:
        model_file = folder / f"{method}.safetensors"
        if not arguments.model and not model_file.exists():
            options = training_options(arguments, scheme, method)
            with Bars() as bars:
                jaxfit.save(train(learned, scheme, method=method, options=options, progress=bars).model, model_file)
        model = jaxfit.load(method if arguments.model else model_file)
        for name, faces in tested.items():
            path = folder / f"{quote(f'{method}-{name}', safe='')}.csv"
            if not path.exists():
                found = [medians(model, scheme, faces, degrees, arguments) for degrees in arguments.degrees]
                lines = zip(COUNTS, *found, strict=True)
                write_csv(path, ["initialisations", *map(str, arguments.degrees)], [list(line) for line in lines])
            with open(path, encoding="utf-8", newline="") as file:
                for count, row in zip(COUNTS, csv.DictReader(file), strict=True):
                    numbers = {key: float(value) for key, value in row.items()}
                    rows.append({"dataset": name, "method": method, **numbers, "initialisations": count})
    columns = {"dataset": "", "method": "", "initialisations": "d", **{str(d): ".4f" for d in arguments.degrees}}
    counts = ", ".join(f"{len(faces)} of {name}" for name, faces in tested.items())
    about = (
        f"Median NMED over the outer eye corners of faces that were not trained on ({counts}) against the rotation of "
        "the picture in degrees."
    )
    report.table(rows, columns, above=about)
    report.title = "Pictures turned in the plane"
    draw(rows, arguments.degrees, folder / "rotations.png")


def medians(
    model: jaxfit.Model, scheme: Scheme, faces: list[FaceRecord], degrees: float, arguments: argparse.Namespace
) -> list[float]:
    """Median error of faces in pictures turned by ``degrees``, for each number of initialisations.

    Every start is fitted once, however many numbers of initialisations it belongs to.
    """
    turned = [turn(face, degrees) for face in faces]
    truth = np.stack([points for _, points in turned])
    # The boxes that upright faces would get: around the turned points, moved and scaled alike.
    placed = [replace(face, landmarks=points) for face, points in zip(faces, truth, strict=True)]
    boxes = start_boxes(placed, arguments.seed)
    crops, problems = jaxfit.crop_faces(model, [picture for picture, _ in turned], boxes)
    if problems:
        raise InputError(f"faces that cannot be fitted: {'; '.join(map(str, problems))}")
    starts = {count: np.asarray(Starts(count, *arguments.rotations).rotations) for count in COUNTS}
    every = np.unique(np.concatenate(list(starts.values())))
    fits = np.asarray(fit_all(model.cascade, jnp.asarray(crops.pixels), jnp.asarray(every)))
    found = []
    for count in COUNTS:
        candidates = fits[:, np.searchsorted(every, starts[count])]
        chosen = np.asarray(jax.vmap(centroid)(jnp.asarray(candidates)))
        landmarks = crops.to_images(candidates[np.arange(len(faces)), chosen].astype(float))
        landmarks = convert(landmarks, model.scheme, scheme)
        found.append(float(np.median(nmed(landmarks, truth, scheme, "outer"))))
    return found


@jax.jit
def fit_all(cascade: Cascade, crops: jax.Array, rotations: jax.Array) -> jax.Array:
    """The fits of every crop from every rotation: (faces, starts, landmarks, 2)."""
    starts = starts_of(cascade.space, cascade.frame, rotations)
    return fit_starts(cascade, crops, starts)


def turn(face: FaceRecord, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """A face's surroundings, turned clockwise about the face, and its landmarks there."""
    grey = read_grey(face.image)
    square = bounding_square(face.landmarks)
    side = int(3 * square[2])
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.array([[cos, -sin], [sin, cos]])
    offset = side / 2 - rotation @ box_centre(square)
    picture = cv2.warpAffine(grey, np.c_[rotation, offset], (side, side), borderMode=cv2.BORDER_REPLICATE)
    return picture, face.landmarks @ rotation.T + offset


def draw(rows: Sequence[dict[str, Any]], degrees: Sequence[float], path: Path) -> None:
    """A panel for each dataset and method: errors against the rotation, a line for each number of initialisations."""
    from matplotlib import colormaps

    panels = list(dict.fromkeys((row["dataset"], row["method"]) for row in rows))
    figure = new_figure(4.0 * len(panels), 3.6)
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)
    for (dataset, method), ax in zip(panels, axes[0], strict=True):
        for row in rows:
            if (row["dataset"], row["method"]) == (dataset, method):
                shade = colormaps["viridis"](COUNTS.index(row["initialisations"]) / len(COUNTS))
                ax.plot(degrees, [row[str(d)] for d in degrees], "o-", ms=3, color=shade, label=row["initialisations"])
        ax.set(title=f"{dataset}, {method}", xlabel="rotation of the picture (degrees)", ylim=(0, 0.3))
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("median NMED")
    axes[0, -1].legend(title="initialisations", fontsize="small")
    save_figure(figure, path, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
