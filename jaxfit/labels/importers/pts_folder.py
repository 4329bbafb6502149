"""Folders of iBUG's .pts annotations: one text file a face, beside a picture of the same stem."""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from jaxfit.data.pictures import READABLE_SUFFIXES
from jaxfit.data.pts import check_base, read_pts
from jaxfit.errors import DatasetError
from jaxfit.labels.records import Dataset, FaceRecord, check_pictures
from jaxfit.schemes.known import scheme_of_count


def read_pts_folder(folder: str | Path, base: int = 1) -> Dataset:
    """Every ``.pts`` directly in ``folder``, sorted by name; its picture has the same stem, or, as ``NAME_1.pts`` of
    fits, the stem before the last ``_`` and number; it is a ``.jpg`` of the same stem if there is none. Of several
    pictures of a stem the first by name is taken, which is reported. Where there are both kinds of picture, and no
    ``NAME.pts``, either may be meant: such files become problems.

    All faces have the number of points that most files have; files that cannot be used become problems. Points
    ``nan nan`` are missing; a point at (0, 0) or (-1, -1) is a point.

    Args:
        folder: where the files are.
        base: what the files call the first pixel: 1 as iBUG does, or 0.

    Raises:
        DatasetError: no such folder, nothing in it can be used, or no ``.pts`` has a picture.
        InputError: ``base`` is neither 0 nor 1.
    """
    check_base(base)
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: expected a folder of .pts files with their pictures, found none; check the path")
    files = sorted(path for path in folder.iterdir() if path.is_file())
    pictures: dict[str, list[Path]] = {}
    for path in files:
        if path.suffix.lower() in READABLE_SUFFIXES:
            pictures.setdefault(path.stem, []).append(path)
    found, problems = read_all_pts([path for path in files if path.suffix.lower() == ".pts"], base)
    labelled = {path.stem for path in files if path.suffix.lower() == ".pts"}
    of_label: dict[Path, Path] = {}
    for path in found:
        own, of_fit = pictures.get(path.stem, []), pictures.get(picture_stem(path), [])
        if own and of_fit and picture_stem(path) not in labelled:
            problems.append(
                f"{path}: may belong to {own[0]} or, as a face that was fitted in it, to {of_fit[0]}; move one of the "
                f"pictures elsewhere, or give {of_fit[0].name} its own .pts"
            )
            continue
        some = own or of_fit or [path.with_suffix(".jpg")]
        of_label[path] = some[0]
        if len(some) > 1:
            problems.append(f"{path}: {some[0].name} and {some[1].name} have its name; the first is taken")
    found = {path: found[path] for path in of_label}
    if not found:
        reason = f"; first problem: {problems[0]}" if problems else ""
        expected = "expected .pts files, each with a picture of the same name beside it"
        raise DatasetError(f"{folder}: {expected}, found none that can be used{reason}")
    count = Counter(len(landmarks) for landmarks in found.values()).most_common(1)[0][0]
    problems += [
        f"{path}: has {len(landmarks)} points, the folder's other faces have {count}"
        for path, landmarks in found.items()
        if len(landmarks) != count
    ]
    faces = tuple(
        _record(path.stem, of_label[path], landmarks) for path, landmarks in found.items() if len(landmarks) == count
    )
    check_pictures(folder, faces)
    spec = f"{'pts' if base == 1 else 'pts0'}:{folder}"
    return Dataset(spec=spec, scheme=scheme_of_count(count), faces=faces, problems=tuple(problems))


def read_all_pts(annotations: list[Path], base: int) -> tuple[dict[Path, np.ndarray], list[str]]:
    """The landmarks (L, 2) of each file that can be read, and the problems of the others."""
    found, problems = {}, []
    for path in annotations:
        try:
            found[path] = read_pts(path, base)
        except DatasetError as error:
            problems.append(str(error))
    return found, problems


def picture_stem(label: Path) -> str:
    """The stem of the picture that a ``.pts`` file is of, if it is one of those that fits write: ``NAME_2.pts``."""
    numbered = re.fullmatch(r"(.+)_[1-9][0-9]*", label.stem)
    return numbered[1] if numbered else ""


def _record(face: str, picture: Path, landmarks: np.ndarray) -> FaceRecord:
    present = np.isfinite(landmarks).all(1)
    # One or two trailing digits number the pictures of one subject; longer numbers are names (image_0001).
    numbered = re.fullmatch(r"(.+)_[0-9]{1,2}", picture.stem)
    return FaceRecord(
        image=picture,
        landmarks=landmarks,
        present=present,
        visible=present.copy(),
        box=None,
        pose=None,
        subject=numbered[1] if numbered else picture.stem,
        face=face,
    )
