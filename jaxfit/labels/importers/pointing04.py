"""Pointing'04: head poses from the names of the pictures, face boxes from the text files beside them; no landmarks."""

import re
from pathlib import Path

import numpy as np

from jaxfit.data.inputs import read_text
from jaxfit.data.numbers import number
from jaxfit.errors import DatasetError
from jaxfit.labels.records import Dataset, FaceRecord, check_pictures
from jaxfit.schemes.known import NO_LANDMARKS

_MOST_BYTES = 1 << 16  # of a box
_FOLDER = re.compile(r"Person[0-9]{2}")
# Person, series, number within the series, tilt and pan in degrees: person01146+0+0. Looking at the pictures shows that
# tilt > 0 looks up and pan > 0 turns the nose to the image's left, as our pitch and yaw do.
_NAME = re.compile(r"person([0-9]{2})[0-9][0-9]{2}([+-][0-9]{1,2})([+-][0-9]{1,2})")


def read_pointing04(folder: str | Path) -> Dataset:
    """The faces of Pointing'04, sorted by name, from the ``PersonNN`` folders in ``folder``, or directly in it.

    Tilt and pan are pitch and yaw; the roll is not known, NaN. Pictures of one person share a subject. A face whose
    box cannot be read stays, without one, and is reported. Names that do not say a pose become problems.

    Raises:
        DatasetError: no such folder, it has no faces, or the picture of none of them exists.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: expected the folder that holds Pointing'04's Person01, …, found none")
    people = sorted(path for path in folder.iterdir() if path.is_dir() and _FOLDER.fullmatch(path.name))
    faces, problems = [], []
    for stem in [stem for person in people or [folder] for stem in _stems(person)]:
        named = _NAME.fullmatch(stem.name)
        if named is None:
            problems.append(f"{stem}.*: expected a name such as person01146+0-15, with tilt and pan at its end")
            continue
        try:
            box = _read_box(Path(f"{stem}.txt"))
        except DatasetError as error:
            box = None
            problems.append(f"{error}; the face stays, without a box")
        faces.append(_record(stem, named, box))
    if not faces:
        reason = f"first problem: {problems[0]}" if problems else "there are none"
        raise DatasetError(f"{folder}: expected pictures such as Person01/person01146+0-15.jpg; {reason}")
    check_pictures(folder, faces)
    return Dataset(f"pointing04:{folder}", NO_LANDMARKS, tuple(faces), tuple(problems))


def _stems(folder: Path) -> list[Path]:
    """The paths, without suffix, of all pictures and boxes in ``folder``."""
    files = [path for path in folder.iterdir() if path.suffix in (".jpg", ".txt") and path.is_file()]
    return sorted({path.with_suffix("") for path in files})


def _record(stem: Path, named: re.Match[str], box: np.ndarray | None) -> FaceRecord:
    person, tilt, pan = named.groups()
    return FaceRecord(
        image=Path(f"{stem}.jpg"),
        landmarks=np.zeros((0, 2)),
        present=np.zeros(0, bool),
        visible=np.zeros(0, bool),
        box=box,
        pose=np.array([np.nan, float(tilt), float(pan)]),
        subject=f"Person{person}",
        face=stem.name,
    )


def _read_box(path: Path) -> np.ndarray:
    """The box (4,) of a text file: the picture's name, ``Face``, centre x and y, width and height, a line each.

    Raises:
        DatasetError: the file is missing or says something else.
    """
    try:
        words = read_text(path, _MOST_BYTES).split()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read as text ({error})") from error
    try:
        _, label, *numbers = words
        x, y, width, height = map(number, numbers)
    except ValueError:
        label, x, y, width, height = "", *[np.nan] * 4
    if label != "Face" or not np.isfinite([x, y, width, height]).all() or min(width, height) <= 0:
        raise DatasetError(f"{path}: expected a picture's name, 'Face', centre x, y, width and height, a line each")
    return np.array([x - width / 2, y - height / 2, width, height])
