"""Several fits of a face made one: the centroid, the median, the mean, weighted by confidence, or the surest alone.

Each face is fitted from boxes that are moved and scaled at random, as detectors draw them, and farther. All ways of
fusing see the same fits; one fit alone is the baseline. Errors are NMED over the outer eye corners.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from compare_models import complete, write_report

import jaxfit
from jaxfit.cli.arguments import add_datasets, read_datasets, seed
from jaxfit.cli.main import exit_code
from jaxfit.data.boxes import bounding_square, jitter
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import InputError
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.statistics import signed_rank, summarise
from jaxfit.evaluation.tables import markdown_table
from jaxfit.labels.records import Dataset
from jaxfit.models.model import Model

# Standard deviations of the boxes' places and logarithms of their sizes, in sides: as detectors' are, and worse.
SPREADS = ((0.06, 0.08), (0.15, 0.2))
ALONE = "one fit"
FUSIONS = {
    "centroid": "centroid",
    "median": "median",
    "mean": "mean",
    "mean, weighted by confidence": "confidence",
    "mean, weighted by odds": "odds",
    "the surest": "surest",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file, with a confidence")
    add_datasets(parser)
    parser.add_argument("--starts", type=int, default=5, help="fits of each face (default: 5)")
    parser.add_argument("--seed", type=seed, default=0, help="of the boxes (default: 0)")
    parser.add_argument("--report", metavar="FILE.md", help="replace the figures in this page, or write it")
    return exit_code(run, parser.parse_args())


def run(arguments: argparse.Namespace) -> int:
    model = jaxfit.load(arguments.model)
    if model.confidence is None or arguments.starts < 3:
        raise InputError("expected a model with a confidence (jaxfit train --confidence), and 3 starts or more")
    tables = []
    for dataset in read_datasets(arguments.data, arguments.scheme):
        for place, size in SPREADS:
            rng = np.random.default_rng(arguments.seed)
            errors = fused_errors(
                model, dataset, arguments.starts, lambda box, p=place, s=size, r=rng: jitter(box, r, p, s)
            )
            subjects = [face.subject for face in complete(dataset)]
            name = f"{dataset.spec.rpartition('/')[2]}, {len(subjects)} faces, boxes off by {place:.0%} and {size:.0%}"
            print(table := f"{name}\n\n{compared(errors, subjects)}\n")
            tables.append(table)
    if arguments.report:
        write_report(Path(arguments.report), tables)
    return 0


def fused_errors(
    model: Model, dataset: Dataset, starts: int, moved: Callable[[np.ndarray], np.ndarray]
) -> dict[str, np.ndarray]:
    """The errors (N,) of each way of fusing, of a dataset's complete faces."""
    faces, read = complete(dataset), GreyPictures()
    pictures, squares = [read(face.image) for face in faces], [bounding_square(face.landmarks) for face in faces]
    fits = [jaxfit.fit(model, pictures, np.stack([moved(square) for square in squares])) for _ in range(starts)]
    truth = np.stack([face.landmarks for face in faces])
    found = {ALONE: fits[0].landmarks} | {name: jaxfit.fuse(fits, way) for name, way in FUSIONS.items()}
    return {name: nmed(landmarks, truth, dataset.scheme) for name, landmarks in found.items()}


def compared(errors: dict[str, np.ndarray], subjects: list[str]) -> str:
    rows: list[dict[str, Any]] = []
    for name, of_way in errors.items():
        found = summarise(of_way)
        p = None if name == ALONE else signed_rank(of_way, errors[ALONE], subjects)
        rows.append(
            {
                "fits": name,
                "median NMED": found.median,
                "AUC": found.auc,
                "failures, %": 100 * found.failure,
                f"p against {ALONE}": p,
            }
        )
    columns = {"fits": "", "median NMED": ".4f", "AUC": ".3f", "failures, %": ".1f", f"p against {ALONE}": ".1g"}
    return markdown_table(rows, columns)


if __name__ == "__main__":
    sys.exit(main())
