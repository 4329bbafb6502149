"""Make a model's file smaller: each step moves along few directions, those in which it moves faces most.

The directions are the main ones of the steps that the regressors predict for faces of the data, measured in pixels of
the landmarks (reduced-rank regression, Izenman 1975). What is left out is replaced by its mean. Before and after are
compared on the same faces, subjects paired.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np
from jax import numpy as jnp
from report import Report, error_row, measure, script_parser

import jaxfit
from jaxfit.cascade import first_steps
from jaxfit.cascade.fit import find_clues
from jaxfit.cascade.model import Cascade
from jaxfit.cascade.starts import starts_of
from jaxfit.cli.arguments import add_datasets
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.statistics import signed_rank
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import FaceRecord

FACES = 1500  # that directions are learned from
COMPARED = 500  # others, at most
BATCH = 64


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("model", metavar="MODEL", help="a model, of which no step has directions yet")
    add_datasets(parser)
    parser.add_argument("--rank", type=int, required=True, help="how many directions a step keeps")
    parser.add_argument("smaller", metavar="SMALLER.safetensors", help="the file to write")
    parser.add_argument("--part", default="", metavar="NAME", help="of the page, which is replaced")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    report.begin(arguments.part)
    model, read = jaxfit.load(arguments.model), GreyPictures()
    cascade = model.cascade
    if cascade.directions is not None or not 1 <= arguments.rank < cascade.space.size:
        raise InputError(f"expected steps without directions, and a rank below {cascade.space.size}")
    faces = [face for dataset in read_datasets(arguments.data, arguments.scheme) for face in dataset.faces]
    order = np.random.default_rng(0).permutation(len(faces))
    learned = [faces[number] for number in order[:FACES]]
    crops, _ = jaxfit.crop_faces(model, [read(face.image) for face in learned], start_boxes(learned))
    smaller = replace(model, cascade=limited(cascade, crops.pixels, arguments.rank))
    jaxfit.save(smaller, arguments.smaller)
    others = [faces[number] for number in order[FACES:][:COMPARED]] or learned
    compare({"before": model, "after": jaxfit.load(arguments.smaller)}, others, read, report)


def limited(cascade: Cascade, crops: np.ndarray, rank: int) -> Cascade:
    """A cascade whose steps have this rank, by what they predict in crops (N, H, H)."""
    weigh = pixels_of(cascade)
    weights, biases, directions = [], [], []
    for step, old in enumerate(cascade.weights):
        features = features_of_step(first_steps(cascade, step + 1), crops)
        predicted = np.asarray(features, np.float64) @ np.asarray(old, np.float64)
        mean = predicted.mean(0)
        main = np.linalg.svd((predicted - mean) @ weigh, full_matrices=False)[2][:rank].T
        into, back = weigh @ main, main.T @ np.linalg.inv(weigh)
        weights.append(np.asarray(old, np.float64) @ into)
        directions.append(back)
        biases.append(np.asarray(cascade.biases[step], np.float64) + mean - mean @ into @ back)
    return replace(
        cascade,
        weights=tuple(jnp.asarray(each, jnp.float32) for each in weights),
        biases=jnp.asarray(np.stack(biases), jnp.float32),
        directions=jnp.asarray(np.stack(directions), jnp.float32),
    )


def pixels_of(cascade: Cascade) -> np.ndarray:
    """(P, P) a root of how far steps of parameters move the landmarks of the mean face, in pixels."""
    space = cascade.space
    params = space.place(jax.tree.map(lambda part: part[0], starts_of(space, cascade.frame, jnp.zeros(1))))
    zero = jnp.zeros(space.size, jnp.float32)
    moved = jax.jacfwd(lambda step: space.landmarks(space.advance(params, step)))(zero)
    moved = np.asarray(moved, np.float64).reshape(-1, space.size)
    values, axes = np.linalg.eigh(moved.T @ moved)
    return axes * np.sqrt(np.maximum(values, 1e-6 * values.max())) @ axes.T


def features_of_step(cascade: Cascade, crops: np.ndarray) -> np.ndarray:
    """(N, F) what the last step of a cascade looks at."""
    found = []
    for first in range(0, len(crops), BATCH):
        rows = np.minimum(np.arange(first, first + BATCH), len(crops) - 1)
        features = find_clues(cascade, jnp.asarray(crops[rows]), jnp.zeros(1))[1].features
        found.append(np.asarray(features)[: len(crops) - first])
    return np.concatenate(found)


def compare(models: dict[str, jaxfit.Model], faces: Sequence[FaceRecord], read: GreyPictures, report: Report) -> None:
    """Add the errors of both on the same faces, and the p-value of their difference."""
    boxes = start_boxes(faces)
    errors = {name: evaluate(model, faces, boxes, read=read).errors for name, model in models.items()}
    p = signed_rank(errors["before"], errors["after"], [face.subject for face in faces])
    rows = [{"model": name, "mean": float(np.mean(found)), **error_row(found)} for name, found in errors.items()]
    rows[1]["p"] = p
    columns = {"model": "", "mean": ".4f", "median NMED": ".4f", "failures, %": ".1f", "p": ".2g"}
    report.table(rows, columns, above=f"{len(faces)} faces")


if __name__ == "__main__":
    sys.exit(main())
