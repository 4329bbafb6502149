"""Split data sets into ``train`` and ``test``, by person: ``.pts`` labels as links to files, AFLW as databases.

The figures of ``docs/`` that name ``train/…`` and ``test/…`` are of folders made by this script.
"""

import argparse
import os
import shutil
import sqlite3
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from jaxfit.cli.arguments import add_datasets, out_folder, seed
from jaxfit.cli.main import exit_code
from jaxfit.errors import InputError
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.labels.datasets import parse_spec, read_datasets
from jaxfit.labels.records import FaceRecord

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
        if parse_spec(dataset.spec)[0] not in WRITERS:
            raise InputError(f"expected datasets of the formats {', '.join(WRITERS)}; got {dataset.spec}")
        if names.count(name) > 1:
            raise InputError(f"expected folders of different names; got several called {name}")
        for folder in (Path(arguments.out, part, name) for part in PARTS):
            # Whoever is left there from another split would be in both parts.
            if folder.is_dir() and any(folder.iterdir()):
                raise InputError(f"--out: expected no files in {folder}; delete them, or take another folder")
    for dataset, name in zip(datasets, names, strict=True):
        spec = parse_spec(dataset.spec)
        folds = split_by_subject([face.subject for face in dataset.faces], arguments.folds, arguments.seed)
        tested = folds == arguments.fold
        for part, chosen in zip(PARTS, (~tested, tested), strict=True):
            faces = [face for face, wanted in zip(dataset.faces, chosen, strict=True) if wanted]
            WRITERS[spec[0]](faces, Path(spec[2]), out_folder(str(Path(arguments.out, part, name))))
        print(f"{dataset.spec}: {(~tested).sum()} faces to train, {tested.sum()} to test")
    return 0


def link_files(faces: Sequence[FaceRecord], source: Path, folder: Path) -> None:
    """Links to the faces' pictures and labels."""
    for face in faces:
        for file in (face.image, face.image.with_suffix(".pts")):
            os.symlink(file.resolve(), folder / file.name)


def copy_database(faces: Sequence[FaceRecord], source: Path, folder: Path) -> None:
    """AFLW's database with these faces alone, beside a link to the pictures."""
    place = source if (source / "aflw.sqlite").is_file() else source / "data"
    shutil.copyfile(place / "aflw.sqlite", folder / "aflw.sqlite")
    os.symlink((place / "flickr").resolve(), folder / "flickr")
    with closing(sqlite3.connect(folder / "aflw.sqlite")) as database:
        database.execute("CREATE TEMP TABLE kept (face_id INTEGER PRIMARY KEY)")
        database.executemany("INSERT INTO kept VALUES (?)", [(int(face.face),) for face in faces])
        database.execute("DELETE FROM Faces WHERE face_id NOT IN kept")
        database.execute("DELETE FROM FeatureCoords WHERE face_id NOT IN kept")
        database.commit()


WRITERS = {"pts": link_files, "pts0": link_files, "aflw": copy_database}


if __name__ == "__main__":
    sys.exit(main())
