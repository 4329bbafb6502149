"""Measure how faces lie in the boxes of each detector, and write it where ``jaxfit.models.placements`` finds it.

Datasets give the statistics of their landmark scheme, and of those that it can be converted to. Datasets of --lift join
them with the landmarks that a 3D head model gives their faces, so that turned ones count, too.
"""

import argparse
import json
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.cli.arguments import add_datasets
from jaxfit.cli.main import exit_code
from jaxfit.cli.progress import Bars
from jaxfit.data.boxes import bounding_square
from jaxfit.data.outputs import atomic_write
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import detected_boxes
from jaxfit.heads.model import DEFAULT_HEAD_MODEL, load_head_model
from jaxfit.labels.datasets import read_datasets, shared_scheme
from jaxfit.labels.lifting import lift_labels
from jaxfit.models import placements
from jaxfit.schemes.conversions import convert, sources
from jaxfit.schemes.known import SCHEMES
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.points import mean_face

# A face's side in the measures, which are relative to it.
SIDE = 1.0
FEWEST = 30


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_datasets(parser)
    parser.add_argument("--lift", nargs="+", default=[], metavar="SPEC", help="datasets of other landmarks")
    parser.add_argument("--detectors", nargs="+", default=["yunet", "haar", "dlib", "whole"], help="as in jaxfit fit")
    parser.add_argument("--out", default=str(Path(placements.__file__).with_name("placements.json")))
    return exit_code(run, parser.parse_args())


def run(arguments: argparse.Namespace) -> int:
    datasets = read_datasets(arguments.data, arguments.scheme)
    scheme = shared_scheme(datasets)
    faces = [face for dataset in datasets for face in dataset.faces if face.complete]
    for dataset in read_datasets(arguments.lift, None):
        faces += lift_labels(dataset.faces, dataset.scheme, scheme, load_head_model(DEFAULT_HEAD_MODEL)).faces
    out = Path(arguments.out)
    known = json.loads(out.read_text("utf-8")) if out.exists() else {}
    for spec in arguments.detectors:
        with Bars() as bars:
            boxes, kinds, rotations = detected_boxes(faces, spec, progress=bars)
        print(f"{spec}: {np.isfinite(boxes).all(1).sum()} of {len(faces)} faces found")
        for other in convertible(scheme):
            labels = convert(np.stack([face.landmarks for face in faces]), scheme, other)
            of_scheme = known.setdefault(other.name, {})
            # What was measured on a scheme's own labels is not replaced by converted ones.
            of_scheme |= measured(boxes, np.array(kinds), rotations, labels) | (of_scheme if other != scheme else {})
    with atomic_write(out, "w") as file:
        json.dump(known, file, indent=1, sort_keys=True)
        file.write("\n")
    return 0


def convertible(scheme: Scheme) -> list[Scheme]:
    """The schemes that labels can be converted to, its own among them."""
    possible = []
    for other in SCHEMES.values():
        with suppress(InputError):
            sources(scheme, other)
            possible.append(other)
    return possible


def measured(
    boxes: np.ndarray, kinds: np.ndarray, rotations: np.ndarray, landmarks: np.ndarray
) -> dict[str, dict[str, Any]]:
    """How faces (N, L, 2) lie in boxes (N, 4) of each kind (N,) of which there are some, turned by rotations (N,) in
    degrees; NaN where none was found."""
    squares = np.stack([bounding_square(points) for points in landmarks])
    mean = mean_face((landmarks - squares[:, None, :2]) / squares[:, None, 2:], SIDE)
    result = {}
    found = np.isfinite(boxes).all(1)
    for kind in np.unique(kinds[found]).tolist():
        rows = np.flatnonzero(found & (kinds == kind))
        if len(rows) >= FEWEST:
            placement = placements.measure_placement(boxes[rows], landmarks[rows], mean, SIDE, rotations[rows])
            result[kind] = json.loads(
                json.dumps(asdict(placement), default=float), parse_float=lambda text: round(float(text), 4)
            )
    return result


if __name__ == "__main__":
    sys.exit(main())
