"""Cross-validate methods: k folds split by subject, a table, and tests of whether the methods differ.

A killed run goes on where it was, and methods may join later. Several processes may share the work: give each its own
``--fold`` or ``--method``, then run once more with all for the tables.
"""

import argparse
import csv
import platform
import sys
from functools import partial
from pathlib import Path
from urllib.parse import quote

import jax
import numpy as np

import jaxfit
from jaxfit.cli.arguments import (
    add_datasets,
    add_training,
    out_folder,
    read_datasets,
    shared_scheme,
    training_options,
    variant,
)
from jaxfit.cli.main import exit_code
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.outputs import atomic_write, require_same_settings, write_csv
from jaxfit.errors import InputError
from jaxfit.evaluation.evaluate import evaluate, start_boxes
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.tables import COMPARISON_COLUMNS, SUMMARY_COLUMNS, comparison_row, markdown_table, summary_row
from jaxfit.learning.methods import METHODS
from jaxfit.learning.train import train
from jaxfit.schemes.normalisers import NORMALISER_TITLES, NORMALISERS


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_datasets(parser)
    parser.add_argument(
        "--method",
        nargs="+",
        default=["sdm"],
        help=f"what to train: {', '.join(METHODS)}; later ones are compared with the first. NAME:key=value,key=value "
        "sets options for that method only, such as parametric:sigmas=4,orientation=principal",
    )
    add_training(parser)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--fold", type=int, help="run this fold alone, counted from 0")
    parser.add_argument("--normaliser", choices=NORMALISERS, default="outer")
    parser.add_argument("--out", required=True, metavar="DIR", help="where folds and the table go")
    arguments = parser.parse_args()
    return exit_code(run, arguments)


def run(arguments: argparse.Namespace) -> int:
    datasets = read_datasets(arguments.data, arguments.scheme)
    scheme = shared_scheme(datasets)
    options_of = partial(training_options, arguments, scheme)
    methods = {name: variant(name, options_of) for name in arguments.method}
    if len(methods) < len(arguments.method):
        raise InputError(f"--method: expected each method once; got {' '.join(arguments.method)}")
    # Methods are trained on complete faces and compared on them.
    faces = [face for dataset in datasets for face in dataset.faces if face.complete]
    for dataset in datasets:
        complete = sum(face.complete for face in dataset.faces)
        print(f"{dataset.spec}: {complete} complete of {len(dataset.faces)} faces")
        report_problems(list(dataset.problems))
    # Named by folder, so that the settings do not depend on where the data lie.
    folders = [Path(dataset.spec.partition(":")[2]).name for dataset in datasets]
    if len(set(folders)) < len(folders):
        raise InputError(f"expected datasets in folders of different names; got {' '.join(folders)}")
    names = [name for name, dataset in zip(folders, datasets, strict=True) for face in dataset.faces if face.complete]
    subjects = [f"{name}/{face.subject}" for name, face in zip(names, faces, strict=True)]
    folds = split_by_subject(subjects, arguments.folds, arguments.seed)
    if arguments.fold is not None and not 0 <= arguments.fold < arguments.folds:
        raise InputError(f"expected --fold from 0 to {arguments.folds - 1}; got {arguments.fold}")
    folder = out_folder(arguments.out)
    # Not the methods: their folds lie side by side.
    settings = {k: v for k, v in sorted(vars(arguments).items()) if k not in ("out", "fold", "data", "method")}
    settings["datasets"] = sorted({name: names.count(name) for name in names}.items())
    require_same_settings(folder / "settings.json", settings)

    for fold in range(arguments.folds) if arguments.fold is None else [arguments.fold]:
        tested = np.flatnonzero(folds == fold)
        held_out = [faces[i] for i in tested]
        learned = [faces[i] for i in np.flatnonzero(folds != fold)]
        for name, (method, options) in methods.items():
            path = _fold_file(folder, fold, name)
            if path.exists():
                continue
            print(f"fold {fold}, {name}: {len(learned)} faces to train, {len(held_out)} to test", flush=True)
            with Bars() as bars:
                trained = train(learned, scheme, method=method, options=options, progress=bars)
                result = evaluate(
                    trained.model,
                    held_out,
                    start_boxes(held_out, arguments.seed),
                    normaliser=arguments.normaliser,
                    initialisations=options.initialisations,
                    rotations=options.rotations,
                    progress=bars,
                )
            report_problems([*trained.problems, *result.problems.values()])
            columns = {"nmed": result.errors} | ({} if result.errors_3d is None else {"nmed_3d": result.errors_3d})
            errors = zip(*(map(repr, column.tolist()) for column in columns.values()), strict=True)
            rows = [(names[i], faces[i].face, *row) for i, row in zip(tested, errors, strict=True)]
            write_csv(path, ["dataset", "face", *columns], rows)

    paths = {name: [_fold_file(folder, fold, name) for fold in range(arguments.folds)] for name in methods}
    if not all(path.exists() for of_method in paths.values() for path in of_method):
        return 0
    tables = _tables(
        {name: _errors(of_method, "nmed") for name, of_method in paths.items()}, list(dict.fromkeys(names))
    )
    in_3d = {
        name: _errors(of_method, "nmed_3d") for name, of_method in paths.items() if METHODS[methods[name][0]].in_3d
    }
    if in_3d:
        tables.append("In 3D, against labels with the depths of the 3D shape model that is aligned to them:")
        tables += _tables(in_3d, list(dict.fromkeys(names)))
    about = (
        f"{arguments.folds}-fold cross-validation of {scheme.name} landmarks, split by subject; NMED over "
        f"{NORMALISER_TITLES[arguments.normaliser]}.\n"
        f"jaxfit {jaxfit.__version__}, jax {jax.__version__}, {platform.machine()}."
    )
    text = "\n\n".join([about, *tables]) + "\n"
    with atomic_write(folder / "table.md", "w") as file:
        file.write(text)
    print(text, end="")
    return 0


def _fold_file(folder: Path, fold: int, method: str) -> Path:
    """Where the errors of a method's fold go; whatever the method's options, a good name and one of its own."""
    return folder / f"fold{fold}-{quote(method.replace(':', '-'), safe='=,')}.csv"


def _errors(paths: list[Path], column: str) -> dict[tuple[str, str], float]:
    """The errors in a column of fold files, by dataset and face."""
    errors = {}
    for path in paths:
        with open(path, encoding="utf-8", newline="") as file:
            errors.update({(row["dataset"], row["face"]): float(row[column]) for row in csv.DictReader(file)})
    return errors


def _tables(errors: dict[str, dict[tuple[str, str], float]], datasets: list[str]) -> list[str]:
    """Each method's errors, and how those of the later methods differ from those of the first."""
    first, *others = errors
    groups = {name: [face for face in errors[first] if face[0] == name] for name in datasets}

    def of(method: str, faces: list[tuple[str, str]]) -> np.ndarray:
        return np.array([errors[method][face] for face in faces])

    rows = [
        {"dataset": name, "method": method, **summary_row(of(method, faces))}
        for name, faces in groups.items()
        for method in errors
    ]
    tables = [markdown_table(rows, {"dataset": "", "method": "", **SUMMARY_COLUMNS})]
    if others:
        together = {"all": list(errors[first])} if len(groups) > 1 else {}
        rows = [
            {"dataset": name, "method": other, **comparison_row(of(other, faces), of(first, faces))}
            for name, faces in [*groups.items(), *together.items()]
            for other in others
        ]
        tables.append(
            f"Compared with {first}, on the same faces; below zero is better:\n\n"
            + markdown_table(rows, {"dataset": "", "method": "", **COMPARISON_COLUMNS})
        )
    return tables


if __name__ == "__main__":
    sys.exit(main())
