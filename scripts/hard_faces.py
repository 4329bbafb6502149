"""Errors of models on hard faces: by how far they are turned, by their size, sharpness and light, and by data set.

Faces start from the squares of ``jaxfit evaluate``, the same for all models. Errors are means over the labelled points
that a data set shares with a model, over the outer eye corners, or over the box's side where labels of poses say that
some faces are turned. Yaws are the labelled ones, else those of the head model on the labels. Give models that learned
from none of the pictures: twins of the bundled ones, built with ``scripts/build_models.py --split``.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from report import Report, dataset_names, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets
from jaxfit.data.pictures import GreyPictures, Read, to_grey
from jaxfit.errors import ImageError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.statistics import signed_rank
from jaxfit.heads.model import load_head_model
from jaxfit.labels.aligned import align_labels
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import Dataset, FaceRecord

BANDS = (0, 15, 30, 45, 60, 180)  # degrees of yaw, to either side
PARTS = 4  # of all faces, by size and so on
SIDE = 64  # of the face that sharpness is measured on, in pixels
VARIANCE = 0.99  # of the head model


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("models", nargs="+", metavar="NAME=MODEL", help="models; the first is compared with the others")
    add_datasets(parser)
    parser.add_argument("--part", default="", metavar="NAME", help="of the page, which is replaced")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    report.begin(arguments.part)
    models = {name: jaxfit.load(path) for name, _, path in (text.rpartition("=") for text in arguments.models)}
    datasets = read_datasets(arguments.data, arguments.scheme)
    read = GreyPictures()
    measured = []
    for name, dataset in zip(dataset_names(datasets), datasets, strict=True):
        errors = errors_of(models, dataset, read)
        measured.append((dataset, errors))
        add_set(report, name, dataset, errors)
        add_bands(report, name, dataset, errors)
    for what, values in conditions([dataset for dataset, _ in measured], read).items():
        add_parts(report, what, values, [errors for _, errors in measured])


def errors_of(models: Mapping[str, jaxfit.Model], dataset: Dataset, read: Read) -> dict[str, np.ndarray]:
    """The errors (N,) of each model."""
    boxes = start_boxes(dataset.faces)
    return {
        name: evaluate(model, dataset.faces, boxes, scheme=dataset.scheme, read=read).errors
        for name, model in models.items()
    }


def add_set(report: Report, name: str, dataset: Dataset, errors: Mapping[str, np.ndarray]) -> None:
    """Add means, medians and failures of all faces, and the tests of the first model against the others."""
    subjects, (first, *_) = [face.subject for face in dataset.faces], errors
    rows = [
        {
            "model": model,
            **figures(found),
            "p": None if model == first else signed_rank(errors[first], found, subjects),
        }
        for model, found in errors.items()
    ]
    columns = {"model": "", "mean": ".4f", "median": ".4f", "failures, %": ".1f", "p": ".1g"}
    above = f"{name}, {len(dataset.faces)} faces of {len(set(subjects))} people; p: against {first}, people paired."
    report.table(rows, columns, above=above)


def figures(errors: np.ndarray) -> dict[str, Any]:
    """Mean (of what was fitted), median and failures of errors that could be measured."""
    known = errors[~np.isnan(errors)]
    if not len(known):
        return {"mean": None, "median": None, "failures, %": None}
    fitted = known[np.isfinite(known)]
    return {
        "mean": float(fitted.mean()) if len(fitted) else None,
        "median": float(np.median(known)),
        "failures, %": 100 * float((known >= LIMIT).mean()),
    }


def mean_and_failures(errors: np.ndarray) -> str:
    """A cell of a table."""
    found = figures(errors)
    return f"{found['mean']:.4f} / {found['failures, %']:.1f}"


def add_bands(report: Report, name: str, dataset: Dataset, errors: Mapping[str, np.ndarray]) -> None:
    """Add means and failures by yaw."""
    yaws = np.abs(yaws_of(dataset))
    bands = [(low, high, (yaws >= low) & (yaws < high)) for low, high in pairwise(BANDS)]
    bands = [band for band in bands if band[2].sum() >= 10]
    titles = [f"{low}–{high}°" if high < BANDS[-1] else f"over {low}°" for low, high, _ in bands]
    rows: list[dict[str, object]] = [
        {"model": "faces", **{title: str(chosen.sum()) for title, (*_, chosen) in zip(titles, bands, strict=True)}}
    ]
    for model, found in errors.items():
        cells = [figures(found[chosen]) for *_, chosen in bands]
        values = {
            title: f"{cell['mean']:.4f} / {cell['failures, %']:.1f}" for title, cell in zip(titles, cells, strict=True)
        }
        rows.append({"model": model, **values})
    report.table(rows, {"model": "", **dict.fromkeys(titles, "")}, above=f"{name} by yaw: mean / failures in %")


def yaws_of(dataset: Dataset) -> np.ndarray:
    """(N,) degrees: as labelled, else as the head model tells from the labels; NaN where neither does."""
    labelled = np.array([np.nan if face.pose is None else face.pose[2] for face in dataset.faces], float)
    head = load_head_model().of(dataset.scheme, VARIANCE)
    points = np.stack([np.where(face.known[:, None], face.landmarks, np.nan) for face in dataset.faces])
    found = align_labels(head, points)
    return np.where(np.isfinite(labelled), labelled, np.where(found.ok, found.pose[:, 2], np.nan))


def conditions(datasets: Sequence[Dataset], read: Read) -> dict[str, list[np.ndarray]]:
    """For each data set, its faces' sides in pixels, their sharpness (standard deviation of the Laplacian of the face
    at one size, over that of its greys) and their light (mean grey)."""
    names = ("side of the face, pixels", "sharpness", "light, grey values")
    found: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for dataset in datasets:
        values = np.array([condition(face, read) for face in dataset.faces])
        for name, column in zip(names, values.T, strict=True):
            found[name].append(column)
    return found


def condition(face: FaceRecord, read: Read) -> tuple[float, float, float]:
    """Side, sharpness and light of a face; NaN if its picture cannot be read."""
    points = face.landmarks[face.known]
    low, high = np.floor(points.min(0)).astype(int), np.ceil(points.max(0)).astype(int) + 1
    try:
        grey = to_grey(read(face.image))
    except (ImageError, OSError):
        return np.nan, np.nan, np.nan
    cut = grey[max(low[1], 0) : max(high[1], 1), max(low[0], 0) : max(high[0], 1)]
    if not cut.size:
        return np.nan, np.nan, np.nan
    small = cv2.resize(cut, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    sharp = cv2.Laplacian(small, cv2.CV_32F).std() / max(small.std(), 1.0)
    return float((high - low).max()), float(sharp), float(small.mean())


def add_parts(
    report: Report, what: str, values: Sequence[np.ndarray], errors: Sequence[Mapping[str, np.ndarray]]
) -> None:
    """Add means and failures of the least quarter of all faces by a condition, the next, and so on."""
    every = np.concatenate(values)
    edges = np.nanquantile(every, np.linspace(0, 1, PARTS + 1))
    parts = np.clip(np.searchsorted(edges, every, side="right") - 1, 0, PARTS - 1)
    titles = [f"{low:.3g} to {high:.3g}" for low, high in pairwise(edges)]
    rows = []
    for model in errors[0]:
        found = np.concatenate([each[model] for each in errors])
        cells = [mean_and_failures(found[(parts == part) & np.isfinite(every)]) for part in range(PARTS)]
        rows.append({"model": model, **dict(zip(titles, cells, strict=True))})
    above = f"All data sets by {what}, quarters of the faces: mean / failures in %"
    report.table(rows, {"model": "", **dict.fromkeys(titles, "")}, above=above)


if __name__ == "__main__":
    sys.exit(main())
