"""Errors of several models, and of dlib's shape predictor, on the same faces from the same boxes, with paired tests.

Faces start from the bounding squares of their landmarks, moved and scaled as in ``jaxfit evaluate``; errors are NMED
over the outer eye corners, AUC and failures at 0.08. Each model is compared with the first one, and with dlib's
predictor if there is one; the tests pair people.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from report import ERROR_COLUMNS, Report, dataset_names, error_row, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets, seed
from jaxfit.data.boxes import bounding_square, jitter
from jaxfit.data.pictures import GreyPictures, read_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.statistics import signed_rank
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.models.digests import DigestingReader

RIVAL = "dlib"


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("models", nargs="+", metavar="MODEL", help="bundled models' names or model files")
    add_datasets(parser)
    parser.add_argument("--dlib-model", metavar="FILE", help="dlib's shape predictor, as benchmark.py trains it")
    parser.add_argument("--seed", type=seed, default=0, help="of the boxes (default: 0)")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    models = {Path(name).stem: jaxfit.load(name) for name in arguments.models}
    datasets = read_datasets(arguments.data, arguments.scheme)
    schemes = {model.scheme for model in models.values()} | {dataset.scheme for dataset in datasets}
    if len(schemes) > 1 or len(models) < len(arguments.models):
        raise InputError(
            "expected models of different names, and one landmark scheme; got "
            f"{', '.join(arguments.models)} and {', '.join(sorted(scheme.name for scheme in schemes))}"
        )
    for name, dataset in zip(dataset_names(datasets), datasets, strict=True):
        errors = measured(models, dataset, arguments.dlib_model, arguments.seed)
        subjects = [face.subject for face in complete(dataset)]
        others = [next(iter(errors))] + [RIVAL] * (RIVAL in errors)
        learned = {each: count_learned(model, dataset) for each, model in models.items()}
        add_comparison(report, f"{name}, {len(subjects)} faces", "model", errors, others, subjects, learned)


def complete(dataset: Dataset) -> list[FaceRecord]:
    """The faces with all landmarks.

    Raises:
        InputError: there are none.
    """
    if not (faces := [face for face in dataset.faces if face.complete]):
        raise InputError(f"{dataset.spec}: expected faces with all {dataset.scheme.count} landmarks; got none")
    return faces


def count_learned(model: jaxfit.Model, dataset: Dataset) -> int | None:
    """How many of the complete faces of a dataset a model learned from; None if it does not say."""
    if (digests := model.learned) is None:
        return None
    reader = DigestingReader(read_grey)
    return int(reader.among([face.image for face in complete(dataset)], digests).sum())


def measured(models: dict[str, Any], dataset: Dataset, rival: str | None, seed: int) -> dict[str, np.ndarray]:
    """The errors (N,) of each model by its name, on the complete faces of a dataset."""
    faces, read = complete(dataset), GreyPictures()
    rng = np.random.default_rng(seed)
    boxes = np.stack([jitter(bounding_square(face.landmarks), rng) for face in faces])
    truth = np.stack([face.landmarks for face in faces])
    pictures = [read(face.image) for face in faces]
    found = {name: jaxfit.fit(model, pictures, boxes).landmarks for name, model in models.items()}
    if rival:
        from benchmark_dlib import load_rival, rival_fits

        first = next(iter(models.values()))
        found[RIVAL] = rival_fits(load_rival(Path(rival), dataset.scheme), first, faces, boxes)
    return {name: nmed(points, truth, dataset.scheme) for name, points in found.items()}


def add_comparison(
    report: Report,
    above: str,
    what: str,
    errors: Mapping[str, np.ndarray],
    others: Sequence[str],
    subjects: Sequence[str],
    learned: Mapping[str, int | None] | None = None,
) -> None:
    """Add a table: what each row errs, and the p-values of its difference from some others, which pair people; with
    ``learned``, also how many of the faces a row's model learned from."""
    rows: list[dict[str, Any]] = []
    for name, found in errors.items():
        tests = {
            f"p against {other}": None if other == name else signed_rank(found, errors[other], subjects)
            for other in others
        }
        known = (learned or {}).get(name)
        rows.append({what: name, "learned from": "unknown" if known is None else known, **error_row(found), **tests})
    of_learned = {} if learned is None else {"learned from": ""}
    report.table(
        rows,
        {what: "", **of_learned, **ERROR_COLUMNS, **{f"p against {other}": ".1g" for other in others}},
        above=above,
    )


if __name__ == "__main__":
    sys.exit(main())
