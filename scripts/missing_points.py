"""What faces with missing landmarks teach: complete faces alone, filled by a head model, and fine-tuned with masks.

A part of the people is kept aside. Five models learn from the others: from complete faces (greedy training, and tuned
end to end), and from all (greedy on landmarks that a 3D head model fills in, and tuned end to end by labelled ones
alone, or by what was filled in as well). They are tested on complete faces, by the NMED over the outer eye corners, and
on the labelled points of all, by the labelled yaw: mean distance in sides of the square around them. All fits start
from the same boxes.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from report import ERROR_COLUMNS, Report, error_row, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets, add_training, training_options
from jaxfit.cli.progress import Bars
from jaxfit.data.boxes import bounding_square
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.statistics import signed_rank
from jaxfit.heads.model import load_head_model
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.lifting import fill_labels
from jaxfit.labels.records import FaceRecord
from jaxfit.models.model import Model
from jaxfit.schemes.scheme import Scheme

BANDS = ((0, 15), (15, 30), (30, 45), (45, 60), (60, 90), (0, 45), (45, 90))  # |yaw| in degrees
YAW = 2


def main() -> int:
    parser = script_parser(__doc__)
    add_datasets(parser)
    add_training(parser)
    parser.add_argument("--folds", type=int, default=5, help="one of so many parts of the people is tested")
    parser.add_argument("--epochs", type=int, default=jaxfit.Tuning.epochs, help="of fine-tuning")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    (dataset,) = read_datasets(arguments.data, arguments.scheme)
    tested = split_by_subject([face.subject for face in dataset.faces], arguments.folds, arguments.seed) == 0
    learned, test = ([face for face, of in zip(dataset.faces, tested, strict=True) if of == part] for part in (0, 1))
    test = [face for face in test if face.image.is_file() and face.present.sum() > 2 and face.pose is not None]
    if not any(face.complete for face in test):
        raise InputError(
            f"{dataset.spec}: expected faces with all landmarks and a pose among those to be tested; got none"
        )
    add_tests(report, trained(learned, dataset.scheme, arguments), test, dataset.scheme)


def trained(faces: Sequence[FaceRecord], scheme: Scheme, arguments: argparse.Namespace) -> dict[str, Model]:
    """The models by their names."""
    options = training_options(arguments, scheme, "sdm")
    tuning, read = jaxfit.Tuning(epochs=arguments.epochs, seed=arguments.seed), GreyPictures()
    complete = [face for face in faces if face.complete]
    filled = fill_labels(faces, scheme, load_head_model(arguments.head_model)).faces
    models = {}
    with Bars() as bars:
        for name, given, ways in (
            ("complete faces", complete, {"fine-tuned": complete}),
            ("all faces", filled, {"fine-tuned": faces, "fine-tuned on guesses too": filled}),
        ):
            made = jaxfit.train(given, scheme, options=options, read=read, progress=bars)
            models[f"{name} ({made.faces})"] = made.model
            for way, tuned_by in ways.items():
                tuned = jaxfit.finetune(made.model, tuned_by, tuning=tuning, validation=0.0, read=read, progress=bars)
                models[f"{name}, {way} ({tuned.faces})"] = tuned.model
    return models


def add_tests(report: Report, models: dict[str, Model], faces: Sequence[FaceRecord], scheme: Scheme) -> None:
    """Add a table of errors on complete faces, and one by yaw."""
    boxes, read = start_boxes(faces), GreyPictures()
    pictures = [read(face.image) for face in faces]
    truth = np.stack([face.landmarks for face in faces])
    known, complete = np.isfinite(truth).all(2), np.array([face.complete for face in faces])
    yaw = np.abs([np.nan if face.pose is None else face.pose[YAW] for face in faces])
    sides = np.array([bounding_square(points)[2] for points in truth])
    subjects = np.array([face.subject for face in faces])
    of_complete: list[dict[str, Any]] = []
    by_yaw: list[dict[str, Any]] = []
    first: dict[str, np.ndarray] = {}
    for name, model in models.items():
        found = jaxfit.fit(model, pictures, boxes).landmarks
        errors = nmed(found[complete], truth[complete], scheme)
        distances = np.where(known, np.linalg.norm(found - truth, axis=2), 0.0)
        # Without a fit they are NaN, and as wrong as can be.
        shares = np.nan_to_num(distances.sum(1) / known.sum(1) / sides, nan=np.inf)
        first = first or {"complete": errors, "shares": shares}
        p = against(errors, first["complete"], subjects[complete])
        of_complete.append({"learned from": name, **error_row(errors), "p": p})
        row: dict[str, Any] = {"learned from": name}
        for low, high in BANDS:
            band = (yaw >= low) & (yaw < high)
            if not band.any():
                continue
            text = f"{np.median(shares[band]):.4f}, {100 * np.mean(shares[band] > LIMIT):.0f} %"
            row[f"{low}–{high}° ({band.sum()})"] = text
            if (low, high) in BANDS[-2:]:
                row[f"p {low}–{high}°"] = against(shares[band], first["shares"][band], subjects[band])
        by_yaw.append(row)
    columns = {"learned from": "", **ERROR_COLUMNS, "p": ".1g"}
    report.table(of_complete, columns, above=f"Complete faces ({complete.sum()}), against the first row:")
    report.table(
        by_yaw,
        {key: ".1g" if key.startswith("p ") else "" for key in by_yaw[0]},
        above=f"Labelled points of all faces by |yaw|: median error, and how many exceed {LIMIT:.0%} of the square's "
        "side, against the first row:",
    )


def against(errors: np.ndarray, first: np.ndarray, subjects: np.ndarray) -> float | None:
    """The p-value of a difference; None between a model and itself."""
    return None if np.array_equal(errors, first) else signed_rank(errors, first, list(subjects))


if __name__ == "__main__":
    sys.exit(main())
