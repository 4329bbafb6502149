"""Cross-validate a method: k folds split by subject, one table a dataset; a killed run goes on at the fold it was in.

Several processes may share the work: give each its own ``--fold``, then run once more without it for the table.
"""

import argparse
import csv
import json
import platform
import sys
from pathlib import Path

import jax
import numpy as np

import jaxfit
from jaxfit.cli.arguments import add_datasets, add_training, out_folder, read_datasets, training_options
from jaxfit.cli.main import keep_compiled_code
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.outputs import atomic_write, write_csv
from jaxfit.evaluating import evaluate, start_boxes
from jaxfit.evaluation.errors import NORMALISER_TITLES, NORMALISERS
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.tables import SUMMARY_COLUMNS, markdown_table, summary_row
from jaxfit.exceptions import InputError, JaxfitError
from jaxfit.training import train


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_datasets(parser)
    add_training(parser)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--fold", type=int, help="run this fold alone, counted from 0")
    parser.add_argument("--normaliser", choices=NORMALISERS, default="outer")
    parser.add_argument("--out", required=True, metavar="DIR", help="where folds and the table go")
    arguments = parser.parse_args()
    keep_compiled_code()
    try:
        return run(arguments)
    except JaxfitError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(arguments: argparse.Namespace) -> int:
    datasets = read_datasets(arguments.data)
    scheme = datasets[0].scheme
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
    settings = {k: v for k, v in sorted(vars(arguments).items()) if k not in ("out", "fold", "data")}
    settings["datasets"] = sorted({name: names.count(name) for name in names}.items())
    _require_same(folder / "settings.json", json.loads(json.dumps(settings)))

    for fold in range(arguments.folds) if arguments.fold is None else [arguments.fold]:
        path = folder / f"fold{fold}.csv"
        if path.exists():
            continue
        tested = np.flatnonzero(folds == fold)
        print(f"fold {fold}: {len(faces) - len(tested)} faces to train, {len(tested)} to test", flush=True)
        with Bars() as bars:
            trained = train(
                [faces[i] for i in np.flatnonzero(folds != fold)],
                scheme,
                method=arguments.method,
                options=training_options(arguments, scheme),
                progress=bars,
            )
            held_out = [faces[i] for i in tested]
            result = evaluate(
                trained.model,
                held_out,
                start_boxes(held_out, arguments.seed),
                normaliser=arguments.normaliser,
                progress=bars,
            )
        report_problems([*trained.problems, *result.problems.values()])
        rows = [(names[i], faces[i].face, repr(e)) for i, e in zip(tested, result.errors.tolist(), strict=True)]
        write_csv(path, ["dataset", "face", "nmed"], rows)

    paths = [folder / f"fold{fold}.csv" for fold in range(arguments.folds)]
    if not all(path.exists() for path in paths):
        return 0
    table = _table(paths, dict.fromkeys(names))
    about = (
        f"{arguments.folds}-fold cross-validation of {arguments.method}, split by subject; NMED over "
        f"{NORMALISER_TITLES[arguments.normaliser]}.\n"
        f"jaxfit {jaxfit.__version__}, jax {jax.__version__}, {platform.machine()}.\n"
    )
    with atomic_write(folder / "table.md", "w") as file:
        file.write(f"{about}\n{table}\n")
    print(about + table)
    return 0


def _require_same(path: Path, settings: dict[str, object]) -> None:
    """Folds of different settings must not be mixed in one table."""
    if not path.exists():
        with atomic_write(path, "w") as file:
            json.dump(settings, file, indent=2)
    elif (before := json.loads(path.read_text())) != settings:
        changed = sorted(k for k in {**before, **settings} if before.get(k) != settings.get(k))
        raise InputError(f"{path.parent} holds folds of other settings ({', '.join(changed)}); use another --out")


def _table(paths: list[Path], names: dict[str, None]) -> str:
    errors: dict[str, list[float]] = {name: [] for name in names}
    for path in paths:
        with open(path, encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                errors[row["dataset"]].append(float(row["nmed"]))
    rows = [{"dataset": name, **summary_row(np.array(values))} for name, values in errors.items()]
    return markdown_table(rows, {"dataset": "", **SUMMARY_COLUMNS})


if __name__ == "__main__":
    sys.exit(main())
