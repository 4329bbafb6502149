"""Errors of several models, and of dlib's shape predictor, on the same faces from the same boxes, with paired tests.

Faces start from the bounding squares of their landmarks, moved and scaled as in ``jaxfit evaluate``; errors are NMED
over the outer eye corners, AUC and failures at 0.08. Each model is compared with the first one, and with dlib's
predictor if there is one; the tests pair people.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxfit
from jaxfit.cli.arguments import add_datasets, read_datasets, seed
from jaxfit.cli.main import exit_code
from jaxfit.data.boxes import bounding_square, jitter
from jaxfit.data.outputs import atomic_write
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import InputError
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.statistics import signed_rank, summarise
from jaxfit.evaluation.tables import markdown_table
from jaxfit.labels.records import Dataset, FaceRecord

RIVAL = "dlib"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="+", metavar="MODEL", help="bundled models' names or model files")
    add_datasets(parser)
    parser.add_argument("--dlib-model", metavar="FILE", help="dlib's shape predictor, as benchmark.py trains it")
    parser.add_argument("--seed", type=seed, default=0, help="of the boxes (default: 0)")
    parser.add_argument("--report", metavar="FILE.md", help="replace the figures in this page, or write it")
    return exit_code(run, parser.parse_args())


def run(arguments: argparse.Namespace) -> int:
    models = {Path(name).stem: jaxfit.load(name) for name in arguments.models}
    datasets = read_datasets(arguments.data, arguments.scheme)
    schemes = {model.scheme for model in models.values()} | {dataset.scheme for dataset in datasets}
    if len(schemes) > 1 or len(models) < len(arguments.models):
        raise InputError(
            "expected models of different names, and one landmark scheme; got "
            f"{', '.join(arguments.models)} and {', '.join(sorted(scheme.name for scheme in schemes))}"
        )
    tables = []
    for dataset in datasets:
        errors = measured(models, dataset, arguments.dlib_model, arguments.seed)
        subjects = [face.subject for face in complete(dataset)]
        print(table := f"{dataset.spec.rpartition('/')[2]}, {len(subjects)} faces\n\n{compared(errors, subjects)}\n")
        tables.append(table)
    if arguments.report:
        write_report(Path(arguments.report), tables)
    return 0


def complete(dataset: Dataset) -> list[FaceRecord]:
    """The faces with all landmarks.

    Raises:
        InputError: there are none.
    """
    if not (faces := [face for face in dataset.faces if face.complete]):
        raise InputError(f"{dataset.spec}: expected faces with all {dataset.scheme.count} landmarks; got none")
    return faces


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


def compared(errors: dict[str, np.ndarray], subjects: Sequence[str]) -> str:
    """A table of all models: what they err, and the p-values of their differences from the first and from dlib's."""
    first = next(iter(errors))
    others = [first] + [RIVAL] * (RIVAL in errors)
    rows: list[dict[str, Any]] = []
    for name, of_model in errors.items():
        found = summarise(of_model)
        row = {"model": name, "median NMED": found.median, "AUC": found.auc, "failures, %": 100 * found.failure}
        tests = {
            f"p against {other}": None if other == name else signed_rank(of_model, errors[other], subjects)
            for other in others
        }
        rows.append(row | tests)
    columns = {"model": "", "median NMED": ".4f", "AUC": ".3f", "failures, %": ".1f"}
    return markdown_table(rows, columns | {f"p against {other}": ".1g" for other in others})


def write_report(page: Path, tables: Sequence[str]) -> None:
    """Replace what stands between the marks of a page; the command stands above."""
    begin, end = "<!-- figures -->\n", "<!-- end of figures -->\n"
    command = f"```\n{' '.join(['python', *sys.argv])}\n```\n\n"
    text = page.read_text(encoding="utf-8") if page.exists() else f"{begin}{end}"
    before, _, rest = text.partition(begin)
    _, _, after = rest.partition(end)
    with atomic_write(page, "w") as file:
        file.write(before + begin + command + "\n".join(tables) + end + after)


if __name__ == "__main__":
    sys.exit(main())
