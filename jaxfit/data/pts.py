"""iBUG's .pts annotations: one text file a face, beside a picture of the same stem."""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from jaxfit.data.images import PICTURE_SUFFIXES
from jaxfit.data.outputs import atomic_write
from jaxfit.data.records import Dataset, FaceRecord, check_pictures
from jaxfit.exceptions import DatasetError, InputError
from jaxfit.shapes.schemes import scheme_of_count


def read_pts(path: str | Path, base: int = 1) -> np.ndarray:
    """Landmarks (L, 2) float64 of a ``.pts`` file, in pixels with pixel centres at integers, 0-based.

    Points ``nan nan``, which are missing, are NaN.

    The header (``version``, ``n_points``, braces) may be missing: then every line is a point ``x y``.

    Args:
        path: the file.
        base: what the file calls the first pixel: 1 as iBUG does, or 0.

    Raises:
        DatasetError: the file is missing, not a list of points, has another number of points than it says, has infinite
            coordinates or one that is NaN alone, or no point that is not missing.
        InputError: ``base`` is neither 0 nor 1.
    """
    _check_base(base)
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read as text ({_reason(error)})") from error
    declared, points = None, []
    for number, line in enumerate(lines, 1):
        key, colon, value = line.partition(":")
        if colon and key.strip().lower() == "n_points":
            declared = value.strip()
        elif not colon and line.strip() not in ("", "{", "}"):
            points.append(_point(path, number, line))
    if not points:
        raise DatasetError(f"{path}: expected lines 'x y', found no points")
    if declared is not None and declared != str(len(points)):
        raise DatasetError(f"{path}: says n_points: {declared} but lists {len(points)} points")
    if np.isnan(points).all():
        raise DatasetError(f"{path}: expected points, found none that is not missing (nan)")
    return np.array(points) - base


def write_pts(path: str | Path, landmarks: np.ndarray, base: int = 1) -> None:
    """Write landmarks (L, 2), 0-based pixels, as a ``.pts`` file with header and three decimals, atomically.

    Raises:
        InputError: the landmarks are not (L, 2) finite numbers, ``base`` is neither 0 nor 1, or the folder is missing.
    """
    _check_base(base)
    landmarks = np.asarray(landmarks, np.float64)
    if landmarks.ndim != 2 or landmarks.shape[1] != 2 or not np.isfinite(landmarks).all():
        raise InputError(f"{path}: expected finite landmarks (L, 2), got an array {landmarks.shape}")
    # Rounding before formatting and adding zero turn "-0.000" into "0.000".
    points = np.round(landmarks + base, 3) + 0.0
    body = "".join(f"{x:.3f} {y:.3f}\n" for x, y in points)
    with atomic_write(path, "w") as file:
        file.write(f"version: 1\nn_points: {len(points)}\n{{\n{body}}}\n")


def read_pts_folder(folder: str | Path, base: int = 1) -> Dataset:
    """Every ``.pts`` directly in ``folder``, sorted by name; its picture has the same stem, ``.jpg`` if there is none.

    All faces have the number of points that most files have; files that cannot be used become problems. Points
    ``nan nan`` are missing; a point at (0, 0) or (-1, -1) is a point.

    Args:
        folder: where the files are.
        base: what the files call the first pixel: 1 as iBUG does, or 0.

    Raises:
        DatasetError: no such folder, nothing in it can be used, or no ``.pts`` has a picture.
        InputError: ``base`` is neither 0 nor 1.
    """
    _check_base(base)
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: expected a folder of .pts files with their pictures, found none; check the path")
    files = sorted(path for path in folder.iterdir() if path.is_file())
    # Reversed, so that of several pictures of one stem the first by name stays.
    pictures = {path.stem: path for path in reversed(files) if path.suffix.lower() in PICTURE_SUFFIXES}
    found, problems = _read_all([path for path in files if path.suffix.lower() == ".pts"], base)
    if not found:
        told = f"; first problem: {problems[0]}" if problems else ""
        expected = "expected .pts files, each with a picture of the same name beside it"
        raise DatasetError(f"{folder}: {expected}, found none that can be used{told}")
    count = Counter(len(landmarks) for landmarks in found.values()).most_common(1)[0][0]
    problems += [
        f"{path}: has {len(landmarks)} points, the folder's other faces have {count}"
        for path, landmarks in found.items()
        if len(landmarks) != count
    ]
    faces = tuple(
        _record(pictures.get(path.stem, path.with_suffix(".jpg")), landmarks)
        for path, landmarks in found.items()
        if len(landmarks) == count
    )
    check_pictures(folder, faces)
    spec = f"{'pts' if base == 1 else 'pts0'}:{folder}"
    return Dataset(spec=spec, scheme=scheme_of_count(count), faces=faces, problems=tuple(problems))


def _read_all(annotations: list[Path], base: int) -> tuple[dict[Path, np.ndarray], list[str]]:
    found, problems = {}, []
    for path in annotations:
        try:
            found[path] = read_pts(path, base)
        except DatasetError as error:
            problems.append(str(error))
    return found, problems


def _record(picture: Path, landmarks: np.ndarray) -> FaceRecord:
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
        face=picture.stem,
    )


def _point(path: str | Path, number: int, line: str) -> tuple[float, float]:
    try:
        x, y = map(float, line.split())
    except ValueError:
        raise DatasetError(f"{path}, line {number}: expected two numbers 'x y', found {line.strip()!r}") from None
    if not (np.isfinite([x, y]).all() or np.isnan([x, y]).all()):
        expected = "expected finite coordinates, or 'nan nan' for a missing point"
        raise DatasetError(f"{path}, line {number}: {expected}, found {line.strip()!r}")
    return x, y


def _check_base(base: int) -> None:
    if base not in (0, 1):
        raise InputError(f"base is what the file calls the first pixel, 0 or 1; got {base}")


def _reason(error: Exception) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else "not UTF-8"
