"""Measure, on people that a model did not learn from, whether its landmarks are as far off as it says, and hidden where
it says so: by data set and yaw, on drawn covers, and what weighing by it brings to poses and to several fits.

Faces start from the squares of ``jaxfit evaluate``. Regions are those of ``Fits.inside``; ranks are compared within
faces; hidden landmarks are those that labels call so, or lack.
"""

import argparse
import csv
import itertools
import sys
from pathlib import Path

import jax
import numpy as np
from hard_faces import BANDS, yaws_of
from jax import numpy as jnp
from report import Report, dataset_names, measure, script_parser

import jaxfit
from jaxfit.cascade.fit import find
from jaxfit.cli.arguments import add_datasets
from jaxfit.cli.progress import Bars
from jaxfit.data.boxes import bounding_square, jitter
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.calibration import auroc
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.uncertainty import SHARES, LandmarkDoubts, landmark_doubts
from jaxfit.labels.datasets import parse_spec, read_datasets
from jaxfit.labels.records import Dataset
from jaxfit.learning.uncertainty import draw_faces
from jaxfit.schemes.conversions import sources
from jaxfit.schemes.known import LFPW29, LFPW29_NAMES

FUSED = 4  # fits of a face
FLAGS = {"obscured": 1, "self-occluded": 2}  # in LFPW's file


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("model", metavar="MODEL", help="a model with an uncertainty")
    add_datasets(parser)
    parser.add_argument("--part", default="", metavar="NAME", help="of the page, which is replaced")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    report.begin(arguments.part)
    model = jaxfit.load(arguments.model)
    if model.uncertainty is None:
        raise InputError(f"expected a model with an uncertainty (--confidence); {arguments.model} has none")
    datasets, read = read_datasets(arguments.data, arguments.scheme), GreyPictures()
    rows, covers, fused, flagged = [], [], [], []
    for name, dataset in zip(dataset_names(datasets), datasets, strict=True):
        with Bars() as bars:
            boxes = start_boxes(dataset.faces)
            result = evaluate(model, dataset.faces, boxes, scheme=dataset.scheme, read=read, progress=bars)
            doubts = landmark_doubts(result)
            rows += [{"faces": name, **row} for row in by_yaw(doubts, np.abs(yaws_of(dataset)))]
            flagged += [{"faces": name, **row} for row in hidden_by_flags(doubts, dataset)]
            if dataset.scheme == model.scheme:
                covers.append({"faces": name, **hidden_by_covers(model, dataset, read)})
                fused.append({"faces": name, **errors_of_ways(model, dataset, read)})
    shares = {f"regions of {share:.0%} hold": ".3f" for share in SHARES}
    columns = {"faces": "", "yaw": "", "landmarks": "d", **shares, "rank correlation": ".2f", "hidden: AUROC": ".3f"}
    report.table(rows, columns, above="Regions, ranks and hidden landmarks")
    if flagged:
        columns = {"faces": "", "hidden": "", "landmarks": "d", "AUROC": ".3f"}
        report.table(flagged, columns, above="Landmarks that LFPW's labels call hidden, against those called visible")
    if not covers:
        return
    report.table(
        covers,
        {"faces": "", "hidden, %": ".1f", "AUROC": ".3f"},
        above="Landmarks below parts of other pictures that were laid over half of the crops",
    )
    ways = {way: ".4f" for way in fused[0] if way != "faces"}
    report.table(
        fused, {"faces": "", **ways}, above=f"Mean error of a face from {FUSED} fits, from boxes moved a little"
    )


def by_yaw(doubts: LandmarkDoubts, yaws: np.ndarray) -> list[dict[str, object]]:
    """A row for all faces, and one for each band of yaw with 30 faces or more."""
    groups = [("all", np.ones(len(yaws), bool))]
    groups += [
        (f"{low}–{high}°" if high < BANDS[-1] else f"over {low}°", (yaws >= low) & (yaws < high))
        for low, high in itertools.pairwise(BANDS)
    ]
    rows: list[dict[str, object]] = []
    for title, chosen in groups:
        if title != "all" and chosen.sum() < 30:
            continue
        some = doubts.some(chosen)
        held = {f"regions of {share:.0%} hold": some.held(share) for share in SHARES}
        rows.append(
            {
                "yaw": title,
                "landmarks": int(np.isfinite(some.lengths).sum()),
                **held,
                "rank correlation": some.ranks,
                "hidden: AUROC": some.hidden,
            }
        )
    return rows


def hidden_by_flags(doubts: LandmarkDoubts, dataset: Dataset) -> list[dict[str, object]]:
    """How well a model tells visible landmarks from those that LFPW's file calls obscured, or self-occluded; none of
    other data sets."""
    kind, _, path, *_ = parse_spec(dataset.spec)
    if kind != "lfpw":
        return []
    with open(path, encoding="utf-8", newline="") as file:
        lines = {Path(line["imgurl"]).stem: line for line in csv.DictReader(file, delimiter="\t")}
    places = [of[0] if len(of) == 1 else None for of in sources(LFPW29, dataset.scheme)]
    states = np.array(
        [
            [np.nan if place is None else int(lines[face.image.stem][f"{LFPW29_NAMES[place]}_t"]) for place in places]
            for face in dataset.faces
        ]
    )
    rows: list[dict[str, object]] = []
    for name, state in FLAGS.items():
        known = np.isin(states, (0, state)) & np.isfinite(doubts.visible)
        rows.append(
            {
                "hidden": name,
                "landmarks": int((states == state).sum()),
                "AUROC": auroc(doubts.visible[known], states[known] == 0),
            }
        )
    return rows


def hidden_by_covers(model: jaxfit.Model, dataset: Dataset, read: GreyPictures) -> dict[str, float]:
    """How many landmarks of covered crops are hidden, and how well the model tells which."""
    with Bars() as bars:
        drawn = draw_faces(model, [face for face in dataset.faces if face.complete], 0, read, bars)
    # All crops at once would take gigabytes.
    parts = np.array_split(drawn.crops, -(-len(drawn.crops) // 256))
    visible = np.concatenate([np.asarray(visible_in(model, jnp.asarray(part))) for part in parts])
    known = np.isfinite(drawn.seen) & np.isfinite(visible)
    hidden = drawn.seen[known] == 0
    return {"hidden, %": 100 * float(hidden.mean()), "AUROC": auroc(visible[known], ~hidden)}


def visible_in(model: jaxfit.Model, crops: jax.Array) -> jax.Array:
    """The probabilities (N, L) that landmarks can be seen in crops."""
    return find(model.cascade, None, crops, jnp.zeros(1), uncertainty=model.uncertainty)["visible"]


def errors_of_ways(model: jaxfit.Model, dataset: Dataset, read: GreyPictures) -> dict[str, float]:
    """The mean errors of a single fit, and of fused ones, by how they are fused."""
    faces = [face for face in dataset.faces if face.complete]
    rng = np.random.default_rng(0)
    pictures, truth = [read(face.image) for face in faces], np.stack([face.landmarks for face in faces])
    fits = [
        jaxfit.fit(model, pictures, np.stack([jitter(bounding_square(points), rng) for points in truth]))
        for _ in range(FUSED)
    ]
    ways = {"one fit": fits[0].landmarks}
    ways |= {way: jaxfit.fuse(fits, way) for way in ("mean", "median", "odds", "precision")}
    return {way: float(np.nanmean(nmed(found, truth, dataset.scheme))) for way, found in ways.items()}


if __name__ == "__main__":
    sys.exit(main())
