"""Time a face of 3D models, by stage: where 3D alignment's goes, and what 3D regression saves (thesis, Table 6)."""

import argparse
import platform
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfit
from jaxfit.cascade.fit import fit_crops, fit_heads
from jaxfit.cli.arguments import add_datasets, read_datasets
from jaxfit.cli.main import exit_code
from jaxfit.cli.progress import report_problems
from jaxfit.data.pictures import read_image
from jaxfit.evaluation.evaluate import start_boxes
from jaxfit.evaluation.tables import markdown_table
from jaxfit.fitting.crop import crop_faces

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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", nargs="+", metavar="NAME=MODEL", help="3D models")
    add_datasets(parser)
    return exit_code(run, parser.parse_args())


def run(arguments: argparse.Namespace) -> int:
    faces = [face for dataset in read_datasets(arguments.data, arguments.scheme) for face in dataset.faces][:FACES]
    images = [read_image(face.image, exif=False) for face in faces]
    rows = []
    for name, _, path in (text.partition("=") for text in arguments.models):
        model = jaxfit.load(path or name)
        crops, problems = crop_faces(model, images, start_boxes(faces))
        report_problems(list(problems.values()))
        pixels = jnp.asarray(crops.pixels)
        landmarks = fit_crops(model.cascade, pixels)
        whole = partial(fit_heads, model.cascade, pixels, None, model.aligned)
        row: dict[str, Any] = {"model": name, "steps": len(model.cascade.windows)}
        median_ms = partial(median_ms_a_face, len(faces))
        row["cascade ms"] = median_ms(partial(fit_crops, model.cascade, pixels))
        if model.aligned is not None:
            encode = jax.jit(lambda points, head=model.aligned: jax.lax.map(head.encode, points, batch_size=4))
            row["alignment ms"] = median_ms(partial(encode, landmarks))
            row["refined ms"] = median_ms(partial(whole, refine=True), 3)
        row["together ms"] = median_ms(whole)
        rows.append(row)
    print(
        f"Milliseconds a face, from crops, {len(faces)} at once, warm, median of {REPETITIONS} (refined: of 3). "
        f"jaxfit {jaxfit.__version__}, jax {jax.__version__}, {platform.machine()}, {jax.devices()[0].device_kind}.\n"
    )
    print(markdown_table(rows, COLUMNS))
    return 0


def median_ms_a_face(faces: int, work: Callable[[], Any], repetitions: int = REPETITIONS) -> float:
    jax.block_until_ready(work())
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - begin)
    return 1000 * float(np.median(times)) / faces


if __name__ == "__main__":
    sys.exit(main())
