"""Several fits of a face made one: the centroid, the median, the mean, weighted by confidence, or the surest alone.

Each face is fitted from boxes that are moved and scaled at random, as detectors draw them, and farther. All ways of
fusing see the same fits; one fit alone is the baseline. Errors are NMED over the outer eye corners.
"""

import argparse
import sys

import numpy as np
from compare_models import add_comparison, complete
from report import Report, dataset_names, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets, seed
from jaxfit.data.boxes import bounding_square, jitter
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import InputError
from jaxfit.evaluation.errors import nmed
from jaxfit.labels.datasets import read_datasets
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
    parser = script_parser(__doc__)
    parser.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file, with a confidence")
    add_datasets(parser)
    parser.add_argument("--starts", type=int, default=5, help="fits of each face (default: 5)")
    parser.add_argument("--seed", type=seed, default=0, help="of the boxes (default: 0)")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    model = jaxfit.load(arguments.model)
    if model.confidence is None or arguments.starts < 3:
        raise InputError("expected a model with a confidence (jaxfit train --confidence), and 3 starts or more")
    datasets = read_datasets(arguments.data, arguments.scheme)
    for name, dataset in zip(dataset_names(datasets), datasets, strict=True):
        subjects = [face.subject for face in complete(dataset)]
        for place, size in SPREADS:
            errors = fused_errors(model, dataset, arguments.starts, (place, size), arguments.seed)
            above = f"{name}, {len(subjects)} faces, boxes off by {place:.0%} and {size:.0%}"
            add_comparison(report, above, "fits", errors, [ALONE], subjects)


def fused_errors(
    model: Model, dataset: Dataset, starts: int, spread: tuple[float, float], seed: int
) -> dict[str, np.ndarray]:
    """The errors (N,) of each way of fusing, of a dataset's complete faces, from boxes off by a spread."""
    faces, read, rng = complete(dataset), GreyPictures(), np.random.default_rng(seed)
    pictures, squares = [read(face.image) for face in faces], [bounding_square(face.landmarks) for face in faces]
    boxes = [np.stack([jitter(square, rng, *spread) for square in squares]) for _ in range(starts)]
    fits = [jaxfit.fit(model, pictures, each) for each in boxes]
    truth = np.stack([face.landmarks for face in faces])
    found = {ALONE: fits[0].landmarks} | {name: jaxfit.fuse(fits, way) for name, way in FUSIONS.items()}
    return {name: nmed(landmarks, truth, dataset.scheme) for name, landmarks in found.items()}


if __name__ == "__main__":
    sys.exit(main())
