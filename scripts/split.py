"""Split folders of pictures with ``.pts`` labels into ``train`` and ``test``, by person, as links to the files.

The figures of ``docs/`` that name ``train/…`` and ``test/…`` are of folders made by this script.
"""

import argparse
import os
import sys
from pathlib import Path

from jaxfit.cli.arguments import add_datasets, out_folder, seed
from jaxfit.cli.main import exit_code
from jaxfit.errors import InputError
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.labels.datasets import parse_spec, read_datasets

LABELS = ("pts", "pts0")
PARTS = ("train", "test")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_datasets(parser)
    parser.add_argument("--folds", type=int, default=5, help="one of so many parts of the people is for testing")
    parser.add_argument("--fold", type=int, default=0, help="which (default: 0)")
    parser.add_argument("--seed", type=seed, default=0, help="of the split (default: 0)")
    parser.add_argument("--out", required=True, metavar="DIR", help="where train and test go")
    return exit_code(run, parser.parse_args())


def run(arguments: argparse.Namespace) -> int:
    if not 0 <= arguments.fold < arguments.folds:
        raise InputError(f"--fold: expected one of 0 to {arguments.folds - 1}; got {arguments.fold}")
    datasets = read_datasets(arguments.data, arguments.scheme)
    names = [Path(parse_spec(dataset.spec)[2]).absolute().name for dataset in datasets]
    for dataset, name in zip(datasets, names, strict=True):
        if parse_spec(dataset.spec)[0] not in LABELS:
            raise InputError(f"expected datasets of the formats {', '.join(LABELS)}; got {dataset.spec}")
        if names.count(name) > 1:
            raise InputError(f"expected folders of different names; got several called {name}")
        for folder in (Path(arguments.out, part, name) for part in PARTS):
            # Whoever is left there from another split would be in both parts.
            if folder.is_dir() and any(folder.iterdir()):
                raise InputError(f"--out: expected no files in {folder}; delete them, or take another folder")
    for dataset, of_dataset in zip(datasets, names, strict=True):
        parts = split_by_subject([face.subject for face in dataset.faces], arguments.folds, arguments.seed)
        counts = dict.fromkeys(PARTS, 0)
        for face, part in zip(dataset.faces, parts, strict=True):
            name = "test" if part == arguments.fold else "train"
            folder = out_folder(str(Path(arguments.out, name, of_dataset)))
            for file in (face.image, face.image.with_suffix(".pts")):
                os.symlink(file.resolve(), folder / file.name)
            counts[name] += 1
        print(f"{dataset.spec}: {counts['train']} faces to train, {counts['test']} to test")
    return 0


if __name__ == "__main__":
    sys.exit(main())
