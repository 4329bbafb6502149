"""How well the openness of eyes and mouth that a model's landmarks say agrees with that of labels.

Faces start from the bounding squares of their labels, moved and scaled as in ``jaxfit evaluate``. No data say which
eyes are closed: an eye is taken to be closed where the labels themselves say so, and a mouth to be open. AUROC is how
often, of two, one that is and one that is not, the fits order them as they should.
"""

import argparse
import sys
from typing import Any

import numpy as np
from report import Report, dataset_names, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets, seed
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.calibration import auroc
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import Dataset
from jaxfit.models.model import Model
from jaxfit.schemes.openness import openings_of, openness

CLOSED = 0.15  # below which an eye's labels say that it is closed
APART = 0.15  # from which a mouth's labels say that it is open
COLUMNS = {
    "dataset": "",
    "what": "",
    "number": "d",
    "event": "",
    "events": "d",
    "AUROC": ".3f",
    "correlation": ".3f",
    "mean of labels": ".3f",
    "mean of fits": ".3f",
    "mean difference": ".3f",
    "learned from": "",
}


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file")
    add_datasets(parser)
    parser.add_argument("--seed", type=seed, default=0, help="of the boxes (default: 0)")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    model, datasets = jaxfit.load(arguments.model), read_datasets(arguments.data, arguments.scheme)
    rows = []
    for name, dataset in zip(dataset_names(datasets), datasets, strict=True):
        rows += [{"dataset": name, **row} for row in rows_of(model, dataset, arguments.seed)]
    report.table(rows, COLUMNS)


def rows_of(model: Model, dataset: Dataset, seed: int) -> list[dict[str, Any]]:
    """A row for the eyes and one for the mouths of the complete faces of a dataset.

    Raises:
        InputError: there are none, or their landmarks do not say how far they are open.
    """
    openings = openings_of(dataset.scheme)
    faces = [face for face in dataset.faces if face.complete]
    if not openings or not faces:
        raise InputError(f"{dataset.spec}: expected complete faces of a scheme with lids and lips; got none")
    result = evaluate(model, faces, start_boxes(faces, seed), scheme=dataset.scheme)
    labels = openness(np.stack([face.landmarks for face in faces]), dataset.scheme)
    fits = openness(result.landmarks, dataset.scheme)
    learned = "unknown" if result.learned is None else str(int(result.learned.sum()))
    eyes = np.array([opening.name.endswith("eye") for opening in openings])
    rows = []
    for what, chosen in (("eyes", eyes), ("mouths", ~eyes)):
        truth, found = labels[:, chosen].ravel(), fits[:, chosen].ravel()
        known = np.isfinite(truth) & np.isfinite(found)
        truth, found = truth[known], found[known]
        event, sign = (truth < CLOSED, -1) if what == "eyes" else (truth >= APART, 1)
        rows.append(
            {
                "what": what,
                "number": len(truth),
                "event": f"closed, below {CLOSED:g}" if what == "eyes" else f"open, from {APART:g}",
                "events": int(event.sum()),
                "AUROC": auroc(sign * found, event),
                "correlation": float(np.corrcoef(truth, found)[0, 1]),
                "mean of labels": truth.mean(),
                "mean of fits": found.mean(),
                "mean difference": np.abs(truth - found).mean(),
                "learned from": learned,
            }
        )
    return rows


if __name__ == "__main__":
    sys.exit(main())
