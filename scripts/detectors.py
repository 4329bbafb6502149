"""Errors of a model from the boxes of each detector, in one, two and three passes of its cascade.

Faces of --data are looked for in their pictures, fitted and measured; those that are not found count as failures.
"""

import argparse
import sys
import time

import numpy as np
from report import Report, measure, script_parser

from jaxfit.cli.arguments import add_datasets
from jaxfit.cli.progress import Bars
from jaxfit.data.detectors import detector_named
from jaxfit.evaluation.boxes import detected_boxes, start_boxes
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.statistics import summarise
from jaxfit.labels.datasets import read_datasets, shared_scheme
from jaxfit.models.files import load

PASSES = (1, 2, 3)
MEASURES = {"median": ".4f", "failure@0.08": ".1%"}
COLUMNS = {"boxes": "", "found": ".1%", "ms to find": ".1f"}
COLUMNS |= {f"{measure}, {passes}": form for passes in PASSES for measure, form in MEASURES.items()}


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file")
    add_datasets(parser)
    parser.add_argument(
        "--detectors", nargs="+", default=["yunet", "haar", "dlib", "whole"], help="as in jaxfit evaluate"
    )
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    model = load(arguments.model)
    datasets = read_datasets(arguments.data, arguments.scheme)
    shared_scheme(datasets)
    faces = [face for dataset in datasets for face in dataset.faces]
    rows = []
    with Bars() as bars:
        squares = start_boxes(faces)
        for name in [None, *arguments.detectors]:
            begin = time.perf_counter()
            found = detected_boxes(faces, name, progress=bars) if name is not None else None
            boxes, kinds, rotations = found or (squares, ["square"] * len(faces), np.zeros(len(faces)))
            seconds = time.perf_counter() - begin
            row: dict[str, object] = {
                "boxes": "perturbed squares" if name is None else detector_named(name).kinds[0].partition("-")[0],
                "found": float(np.isfinite(boxes).all(1).mean()),
                "ms to find": None if name is None else 1000 * seconds / len(faces),
            }
            for passes in PASSES:
                errors = evaluate(
                    model, faces, boxes, kind=kinds, rotations=rotations, passes=passes, progress=bars
                ).errors
                summary = summarise(errors)
                row |= {f"median, {passes}": summary.median, f"failure@0.08, {passes}": summary.failure}
            rows.append(row)
    report.table(rows, COLUMNS, above=f"{len(faces)} faces; NMED over outer eye corners.")


if __name__ == "__main__":
    sys.exit(main())
