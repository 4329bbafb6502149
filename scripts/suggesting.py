"""What `jaxfit suggest` is worth: errors against the number of labelled specimens, suggested ones against random ones.

Each repetition keeps a third of the specimens aside, learns from a few random ones, and then adds some, round by round:
those that the model of the round before suggests, or random ones. Both begin with the same specimens, and have the same
random numbers. Errors are means over the landmarks of the specimens kept aside, fitted from moved boxes, over the side
of the exact box.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from own_objects import options_of
from report import Report, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets
from jaxfit.data.boxes import bounding_square
from jaxfit.data.pictures import GreyPictures
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.statistics import signed_rank
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.suggest import suggest
from jaxfit.models.model import Model

# From the faces known so far and those left: the numbers, among those left, of so many to add.
Chooser = Callable[[Model, Sequence[FaceRecord], int, np.random.Generator], list[int]]


def main() -> int:
    own = script_parser(__doc__)
    add_datasets(own)
    own.add_argument("--labelled", type=int, nargs="+", default=[10, 14, 18, 22, 26], help="(default: 10 14 18 22 26)")
    own.add_argument("--repetitions", type=int, default=10, help="(default: 10)")
    own.add_argument("--train", default="", metavar="OPTIONS", help="of jaxfit train")
    own.add_argument("--part", default="", metavar="NAME", help="of the page, which is replaced")
    return measure(run, own.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    report.begin(arguments.part)
    (dataset,) = read_datasets(arguments.data, arguments.scheme)
    faces, read = [face for face in dataset.faces if face.complete], GreyPictures()

    def trained(learned: Sequence[FaceRecord]) -> Model:
        options = options_of(arguments.train, dataset.scheme, len(learned))
        return jaxfit.train(learned, dataset.scheme, options=options, read=read).model

    choosers: dict[str, Chooser] = {"suggested": suggested, "random": at_random}
    # One row a repetition.
    errors = {name: np.full((arguments.repetitions, len(arguments.labelled)), np.nan) for name in choosers}
    for repetition in range(arguments.repetitions):
        parts = split_by_subject([face.subject for face in faces], 3, repetition)
        tested = [face for face, part in zip(faces, parts, strict=True) if part == 0]
        rest = [face for face, part in zip(faces, parts, strict=True) if part != 0]
        order = np.random.default_rng(repetition).permutation(len(rest))
        begun = [rest[number] for number in order[: arguments.labelled[0]]]
        first = trained(begun)
        for name, choose in choosers.items():
            rng, model, known = np.random.default_rng(repetition), first, list(begun)
            left = [rest[number] for number in order[arguments.labelled[0] :]]
            for column, count in enumerate(arguments.labelled):
                if count > len(known):
                    chosen = choose(model, left, count - len(known), rng)
                    known += [left[number] for number in chosen]
                    left = [face for number, face in enumerate(left) if number not in chosen]
                    model = trained(known)
                errors[name][repetition, column] = mean_error(model, tested, read)
    report.table(rows_of(errors, arguments.labelled), COLUMNS, above=f"{len(faces)} specimens, {len(tested)} aside")


COLUMNS = {"labelled": "d", "suggested": ".4f", "random": ".4f", "suggested is better in": "d", "p": ".2g"}


def rows_of(errors: dict[str, np.ndarray], labelled: Sequence[int]) -> list[dict[str, Any]]:
    """Means over the repetitions, and how often suggestions were better; p of the signed-rank test between both."""
    rows = []
    for column, count in enumerate(labelled):
        both = {name: values[:, column] for name, values in errors.items()}
        row: dict[str, Any] = {"labelled": count} | {name: values.mean() for name, values in both.items()}
        row["suggested is better in"] = int((both["suggested"] < both["random"]).sum())
        row["p"] = signed_rank(both["suggested"], both["random"]) if column else np.nan
        rows.append(row)
    return rows


def suggested(model: Model, left: Sequence[FaceRecord], count: int, rng: np.random.Generator) -> list[int]:
    """Those that `suggest` puts first, in whole pictures."""
    found = suggest(model, [face.image for face in left], count, detector="whole")
    numbers = {face.image: number for number, face in enumerate(left)}
    chosen = [numbers[face.image] for face in found.dataset.faces]
    others = [number for number in range(len(left)) if number not in chosen]  # where nothing was found
    return (chosen + others)[:count]


def at_random(model: Model, left: Sequence[FaceRecord], count: int, rng: np.random.Generator) -> list[int]:
    return [int(number) for number in rng.permutation(len(left))[:count]]


def mean_error(model: Model, tested: Sequence[FaceRecord], read: GreyPictures) -> float:
    """Of the side of the exact box, over all landmarks."""
    truth = np.stack([face.landmarks for face in tested])
    sides = np.array([bounding_square(points)[2] for points in truth])
    found = jaxfit.fit(model, [face.image for face in tested], start_boxes(tested), read=read).landmarks
    return float((np.linalg.norm(found - truth, axis=2) / sides[:, None]).mean())


if __name__ == "__main__":
    sys.exit(main())
