"""Errors on objects of your own, such as wings or skulls, in folds: trainings of jaxfit beside dlib's shape predictor.

Each fold is fitted by what learned from the others, from exact boxes (the bounding squares of the labels), from those
moved and scaled as ``jaxfit evaluate`` does it, and from whole pictures. dlib's predictor has the settings of ml-morph,
and learns from exact boxes, as there. Errors are means over all landmarks, over the side of the exact box, and in units
if ``--pixel`` says how long a pixel is.
"""

import argparse
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from report import Report, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets, training_options
from jaxfit.cli.main import parser
from jaxfit.data.boxes import bounding_square
from jaxfit.data.detectors.whole import KIND as WHOLE
from jaxfit.data.pictures import GreyPictures, picture_size
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.methods import Options
from jaxfit.models.model import SQUARE
from jaxfit.schemes.scheme import Scheme

# ml-morph's (shape_trainer.py), but for the threads.
TREE_DEPTH, CASCADE_DEPTH, NU, OVERSAMPLING, SPLITS, POOL, TREES = 4, 15, 0.1, 10, 20, 500, 500
STARTS = ("exact boxes", "moved boxes", "whole pictures")

# Landmarks (N, L, 2) of faces by what their fits start from, the megabytes of the model, and the seconds of training.
Found = tuple[dict[str, np.ndarray], float, float]


def main() -> int:
    own = script_parser(__doc__)
    add_datasets(own)
    own.add_argument("--folds", type=int, default=5, help="(default: 5)")
    own.add_argument("--pixel", type=float, help="the length of a pixel")
    own.add_argument("--within", type=float, metavar="LENGTH", help="also say how many landmarks are within it")
    own.add_argument("--train", action="append", default=[], metavar="NAME=OPTIONS", help="of jaxfit train; repeatable")
    own.add_argument("--part", default="", metavar="NAME", help="of the page, which is replaced")
    own.add_argument("--dlib", action="store_true", help="train dlib's shape predictor, too")
    return measure(run, own.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    report.begin(arguments.part)
    (dataset,) = read_datasets(arguments.data, arguments.scheme)
    faces = [face for face in dataset.faces if face.complete]
    trainings: dict[str, Callable[[Sequence[FaceRecord], Sequence[FaceRecord]], Found]] = {
        name: with_jaxfit(dataset.scheme, options, read=GreyPictures())
        for name, _, options in (text.partition("=") for text in arguments.train or ["jaxfit="])
    }
    if arguments.dlib:
        trainings["dlib"] = with_dlib
    parts = split_by_subject([face.subject for face in faces], arguments.folds, 0)
    truth = np.stack([face.landmarks for face in faces])
    sides = np.array([bounding_square(points)[2] for points in truth])
    rows: list[dict[str, Any]] = []
    for name, training in trainings.items():
        errors = {start: np.full(truth.shape[:2], np.nan) for start in STARTS}
        sizes, seconds = [], []
        for fold in range(arguments.folds):
            tested = np.flatnonzero(parts == fold)
            found, size, took = training([faces[n] for n in np.flatnonzero(parts != fold)], [faces[n] for n in tested])
            sizes.append(size)
            seconds.append(took)
            for start, landmarks in found.items():
                errors[start][tested] = np.linalg.norm(landmarks - truth[tested], axis=2)
        for start in STARTS:
            if np.isfinite(errors[start]).all():
                row = {"training": name, "starts": start, "megabytes": np.mean(sizes), "seconds": np.mean(seconds)}
                rows.append(row | errors_of(errors[start], sides, arguments.pixel, arguments.within))
    lengths = {"error": ".2f"} if arguments.pixel else {}
    lengths |= {"within, %": ".1f"} if arguments.pixel and arguments.within else {}
    columns = {"training": "", "starts": "", "of the box": ".4f", "pixels": ".2f", **lengths}
    above = f"{len(faces)} specimens of {dataset.scheme.count} landmarks, {arguments.folds} folds"
    report.table(rows, {**columns, "megabytes": ".1f", "seconds": ".0f"}, above=above)


def errors_of(distances: np.ndarray, sides: np.ndarray, pixel: float | None, within: float | None) -> dict[str, float]:
    """Means of distances (N, L) in pixels, over the boxes' sides (N,), and in units."""
    numbers = {"of the box": (distances / sides[:, None]).mean(), "pixels": distances.mean()}
    if pixel:
        numbers["error"] = distances.mean() * pixel
        if within:
            numbers["within, %"] = 100 * (distances * pixel <= within).mean()
    return {name: float(number) for name, number in numbers.items()}


def starting_boxes(faces: Sequence[FaceRecord]) -> dict[str, np.ndarray]:
    """Boxes (N, 4) of each kind."""
    exact = np.stack([bounding_square(face.landmarks) for face in faces])
    whole = np.array([[0, 0, *picture_size(face.image)] for face in faces], float)
    return dict(zip(STARTS, (exact, start_boxes(faces), whole), strict=True))


def options_of(options: str, scheme: Scheme, specimens: int) -> Options:
    """What ``jaxfit train`` would learn with, from these options and so many specimens."""
    words = ["train", "--data", "none", "--out", "none.safetensors", "--no-detectors", *shlex.split(options)]
    return training_options(parser().parse_args(words), scheme, "sdm", specimens)


def with_jaxfit(scheme: Scheme, options: str, read: GreyPictures) -> Callable[..., Found]:
    """A training with options of ``jaxfit train``."""

    def training(learned: Sequence[FaceRecord], tested: Sequence[FaceRecord]) -> Found:
        how = options_of(options, scheme, len(learned))
        begin = time.perf_counter()
        model = jaxfit.train(learned, scheme, options=how, read=read).model
        seconds = time.perf_counter() - begin
        pictures = [face.image for face in tested]
        found = {}
        for start, boxes in starting_boxes(tested).items():
            kind = WHOLE if start == STARTS[2] else SQUARE
            passes = 2 if kind == WHOLE else 1
            found[start] = jaxfit.fit(model, pictures, boxes, kind=kind, passes=passes, read=read).landmarks
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "model.safetensors"
            jaxfit.save(model, file)
            return found, file.stat().st_size / 1e6, seconds

    return training


def with_dlib(learned: Sequence[FaceRecord], tested: Sequence[FaceRecord]) -> Found:
    """dlib's shape predictor as ml-morph trains it; it needs exact boxes to learn from, and knows no whole pictures."""
    import dlib

    options = dlib.shape_predictor_training_options()
    options.tree_depth, options.cascade_depth, options.nu = TREE_DEPTH, CASCADE_DEPTH, NU
    options.oversampling_amount, options.num_test_splits = OVERSAMPLING, SPLITS
    options.feature_pool_size, options.num_trees_per_cascade_level = POOL, TREES
    options.num_threads = 2
    read = GreyPictures()
    labels = [
        [dlib.full_object_detection(rectangle(box), [dlib.point(round(x), round(y)) for x, y in face.landmarks])]
        for face, box in zip(learned, starting_boxes(learned)[STARTS[0]], strict=True)
    ]
    begin = time.perf_counter()
    predictor = dlib.train_shape_predictor([read(face.image) for face in learned], labels, options)
    seconds = time.perf_counter() - begin
    found = {}
    for start, boxes in starting_boxes(tested).items():
        if start != STARTS[2]:
            fits = [predictor(read(face.image), rectangle(box)) for face, box in zip(tested, boxes, strict=True)]
            found[start] = np.array([[(point.x, point.y) for point in fit.parts()] for fit in fits], float)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "predictor.dat"
        predictor.save(str(file))
        return found, file.stat().st_size / 1e6, seconds


def rectangle(box: np.ndarray) -> Any:
    """A box (4,) as dlib takes it."""
    import dlib

    x, y, width, height = box
    return dlib.rectangle(round(x), round(y), round(x + width), round(y + height))


if __name__ == "__main__":
    sys.exit(main())
