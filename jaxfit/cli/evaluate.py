"""``jaxfit evaluate``: measure a model on labelled faces."""

import argparse
import json
from collections.abc import Iterator
from math import isfinite, isnan
from typing import Any

import numpy as np

from jaxfit.cli.arguments import (
    add_boxes,
    add_datasets,
    add_initialisations,
    given_boxes,
    out_folder,
    read_datasets,
    seed,
    untrained_starts,
)
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.datasets import convert_dataset
from jaxfit.data.outputs import atomic_write, write_csv
from jaxfit.data.records import Dataset
from jaxfit.evaluating import Evaluation, evaluate, match_boxes, require_scheme, start_boxes
from jaxfit.evaluation.errors import NORMALISER_TITLES, NORMALISERS
from jaxfit.evaluation.statistics import summarise
from jaxfit.evaluation.tables import SUMMARY_COLUMNS, summary_row, text_table
from jaxfit.models.files import load
from jaxfit.models.model import Model
from jaxfit.shapes.conversions import CONVERSIONS
from jaxfit.shapes.schemes import Scheme

_COLUMNS = {"dataset": "", **SUMMARY_COLUMNS, "ms/face": ".1f"}
_FACE_COLUMNS = ("dataset", "face", "subject", "image", "x", "y", "width", "height", "nmed", "problem")


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "evaluate",
        help="measure a model on labelled faces",
        description="Measure a model on labelled faces: normalised mean Euclidean distance (NMED), AUC and failure "
        "rate at 0.08. Faces that are not found or cannot be read count as failures. Labels of another landmark "
        "scheme than the model's are converted to it where that is possible; or the model's fits to theirs; or both to "
        "what --scheme says.",
    )
    command.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file")
    add_datasets(command)
    add_boxes(command, "fits start from the true landmarks' bounding square, moved by 6 %% and scaled by 8 %%")
    command.add_argument("--seed", type=seed, default=0, help="of those starting squares (default: 0)")
    command.add_argument(
        "--normaliser",
        choices=NORMALISERS,
        default="outer",
        help="what distances are divided by: outer eye corners (default), pupil centres, bounding square",
    )
    add_initialisations(command, "starts a face; several, for models trained for it, find turned faces")
    command.add_argument("--out", required=True, metavar="DIR", help="where report.json and faces.csv go")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Evaluate, print the table, write ``report.json`` and ``faces.csv``."""
    model = load(options.model)
    datasets = read_datasets(options.data, options.scheme)
    if options.scheme is None:
        datasets = [_for_model(model, dataset) for dataset in datasets]
    schemes = [_measured_scheme(model, dataset) for dataset in datasets]
    for dataset, scheme in zip(datasets, schemes, strict=True):
        require_scheme(scheme, dataset.faces)
    boxes = given_boxes(options, model)
    folder = out_folder(options.out)
    results: dict[str, Evaluation] = {}
    with Bars() as bars:
        for dataset, scheme in zip(datasets, schemes, strict=True):
            starts = start_boxes(dataset.faces, options.seed) if boxes is None else match_boxes(dataset.faces, boxes)
            results[dataset.spec] = evaluate(
                model,
                dataset.faces,
                starts,
                kind=options.box_kind,
                scheme=scheme,
                normaliser=options.normaliser,
                initialisations=options.initialisations,
                rotations=tuple(options.rotations),
                progress=bars,
            )
    reports = {spec: _report(result) for spec, result in results.items()}
    with atomic_write(folder / "report.json", "w") as file:
        settings = {
            "boxes": options.boxes,
            "box_kind": options.box_kind,
            "seed": options.seed,
            "initialisations": options.initialisations,
            "rotations": list(options.rotations),
        }
        json.dump({"model": options.model, **settings, "datasets": reports}, file, indent=2)
    write_csv(folder / "faces.csv", _FACE_COLUMNS, _faces(results))
    report_problems(
        untrained_starts(options.model, model, options.initialisations)
        + [problem for dataset in datasets for problem in dataset.problems]
        + [problem for result in results.values() for problem in result.problems.values()]
    )
    print(
        f"NMED over {NORMALISER_TITLES[options.normaliser]}. The mean is over fitted faces; faces without a fit count "
        "in the median, the AUC and the failures. Unmeasured: the points of the normaliser are not annotated."
    )
    print(text_table([_row(spec, result) for spec, result in results.items()], _COLUMNS))
    print(f"written: {folder / 'report.json'}, {folder / 'faces.csv'}")
    return 0


def _for_model(model: Model, dataset: Dataset) -> Dataset:
    """The dataset in the model's landmark scheme where its labels can be converted, which is said; else as it is."""
    if (dataset.scheme.name, model.scheme.name) not in CONVERSIONS:
        return dataset
    print(f"{dataset.spec}: labels converted from {dataset.scheme.name} to the model's {model.scheme.name}")
    return convert_dataset(dataset, model.scheme)


def _measured_scheme(model: Model, dataset: Dataset) -> Scheme:
    """The scheme that errors are measured in: the labels' own where the model's fits can be converted to it."""
    return dataset.scheme if (model.scheme.name, dataset.scheme.name) in CONVERSIONS else model.scheme


def _report(result: Evaluation) -> dict[str, Any]:
    """One dataset's part of ``report.json``; ``ci95`` is half the width of the mean's 95 % confidence interval."""
    seconds = result.seconds_per_face
    fitted = int(np.isfinite(result.landmarks).all((1, 2)).sum())
    return {
        **summarise(result.errors).as_json(),
        "fitted": fitted,
        "undetected": len(result.faces) - fitted,
        "normaliser": NORMALISER_TITLES[result.normaliser],
        "seconds_per_face": seconds if isfinite(seconds) else None,
    }


def _row(spec: str, result: Evaluation) -> dict[str, object]:
    return {"dataset": spec, **summary_row(result.errors), "ms/face": result.seconds_per_face * 1000}


def _faces(results: dict[str, Evaluation]) -> Iterator[list[object]]:
    """A row for each face; ``nmed`` is ``inf`` without a fit, ``nan`` where the truth does not allow to measure."""
    for spec, result in results.items():
        for number, face in enumerate(result.faces):
            box = [f"{value:.3f}" for value in result.boxes[number]]
            error = result.errors[number]
            problem = result.problems.get(number, "the normaliser's points are not annotated" if isnan(error) else "")
            yield [spec, face.face, face.subject, face.image, *box, f"{error:.6f}", problem]
