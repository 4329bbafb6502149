"""Time a face of 3D models, by stage: where 3D alignment's goes, and what 3D regression saves (thesis, Table 6)."""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from report import Report, measure, script_parser
from timing import computed, median_seconds

import jaxfit
from jaxfit.cascade.fit import fit_crops, fit_heads
from jaxfit.cli.arguments import add_datasets
from jaxfit.cli.progress import report_problems
from jaxfit.data.pictures import read_image
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.fitting.crop import crop_faces
from jaxfit.labels.datasets import read_datasets

FACES, REPETITIONS = 64, 32  # the thesis repeats 32 times, too
COLUMNS = {
    "model": "",
    "steps": "d",
    "cascade ms": ".2f",
    "alignment ms": ".2f",
    "together ms": ".2f",
    "refined ms": ".2f",
}


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("models", nargs="+", metavar="NAME=MODEL", help="3D models")
    add_datasets(parser)
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    faces = [face for dataset in read_datasets(arguments.data, arguments.scheme) for face in dataset.faces][:FACES]
    images = [read_image(face.image, exif=False) for face in faces]
    rows = []
    for name, _, path in (text.partition("=") for text in arguments.models):
        model = jaxfit.load(path or name)
        crops, problems = crop_faces(model, images, start_boxes(faces))
        report_problems([str(problem) for problem in problems])
        pixels = jnp.asarray(crops.pixels)
        landmarks, space = fit_crops(model.cascade, pixels), model.aligned
        row: dict[str, Any] = {"model": name, "steps": len(model.cascade.windows)}
        row["cascade ms"] = ms_a_face(len(faces), computed(fit_crops, model.cascade, pixels))
        together = computed(partial(fit_heads, aligned=space), model.cascade, pixels)
        row["together ms"] = ms_a_face(len(faces), together)
        if space is not None:
            align, refine = (jax.jit(partial(jax.lax.map, f, batch_size=4)) for f in (space.encode, space.refined))
            row["alignment ms"] = ms_a_face(len(faces), computed(align, landmarks))
            row["refined ms"] = row["together ms"] + ms_a_face(len(faces), computed(refine, landmarks), 3)
        rows.append(row)
    about = (
        f"Milliseconds a face, from crops, {len(faces)} at once, warm, median of {REPETITIONS} (of 3 where it "
        "is refined afterwards, as `jaxfit fit --refine` does)."
    )
    report.table(rows, COLUMNS, above=about)


def ms_a_face(faces: int, work: Callable[[], Any], repetitions: int = REPETITIONS) -> float:
    return 1000 * median_seconds(work, repetitions) / faces


if __name__ == "__main__":
    sys.exit(main())
