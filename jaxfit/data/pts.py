"""iBUG's .pts files: the landmarks of one face, as text."""

from pathlib import Path

import numpy as np

from jaxfit.data.inputs import read_text
from jaxfit.data.numbers import number
from jaxfit.data.outputs import atomic_write
from jaxfit.errors import DatasetError, InputError

_MOST_BYTES = 1 << 20


def read_pts(path: str | Path, base: int = 1) -> np.ndarray:
    """Landmarks (L, 2) float64 of a ``.pts`` file, in pixels with pixel centres at integers, 0-based.

    Points ``nan nan``, which are missing, are NaN.

    The header (``version``, ``n_points``, braces) may be missing: then every line is a point ``x y``. What follows a
    ``#`` is a comment.

    Args:
        path: the file.
        base: what the file calls the first pixel: 1 as iBUG does, or 0.

    Raises:
        DatasetError: the file is missing, not a list of points, has another number of points than it says, has infinite
            coordinates or one that is NaN alone, or no point that is not missing.
        InputError: ``base`` is neither 0 nor 1.
    """
    check_base(base)
    try:
        lines = read_text(path, _MOST_BYTES).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read as text ({_reason(error)})") from error
    declared, points = None, []
    for line_number, line in enumerate(lines, 1):
        line = line.partition("#")[0].strip()
        key, colon, value = line.partition(":")
        if colon and key.strip().isidentifier():  # a line of the header; not "1:5 2", a damaged point
            declared = value.strip() if key.strip().lower() == "n_points" else declared
        elif line not in ("", "{", "}"):
            points.append(_point(path, line_number, line))
    if not points:
        raise DatasetError(f"{path}: expected lines 'x y', found no points")
    if declared is not None and declared != str(len(points)):
        raise DatasetError(f"{path}: says n_points: {declared} but lists {len(points)} points")
    if np.isnan(points).all():
        raise DatasetError(f"{path}: expected points, found none that is not missing (nan)")
    return np.array(points) - base


def write_pts(path: str | Path, landmarks: np.ndarray, base: int = 1) -> None:
    """Write landmarks (L, 2), 0-based pixels, as a ``.pts`` file with header and three decimals, atomically.

    Points that are NaN, which are missing, become ``nan nan``.

    Raises:
        InputError: the landmarks are not (L, 2) numbers, finite but for missing points, of which not all are missing;
            ``base`` is neither 0 nor 1, or the folder is missing.
    """
    check_base(base)
    landmarks = np.asarray(landmarks, np.float64)
    shaped = landmarks.ndim == 2 and landmarks.shape[1] == 2
    missing = np.isnan(landmarks).all(1, keepdims=True) if shaped else np.zeros((0, 0), bool)
    if not shaped or missing.all() or not (np.isfinite(landmarks) | missing).all():
        raise InputError(f"{path}: expected finite landmarks (L, 2), got an array {landmarks.shape}")
    # Rounding before formatting and adding zero turn "-0.000" into "0.000".
    points = np.round(landmarks + base, 3) + 0.0
    body = "".join(f"{x:.3f} {y:.3f}\n" for x, y in points)
    with atomic_write(path, "w") as file:
        file.write(f"version: 1\nn_points: {len(points)}\n{{\n{body}}}\n")


def _point(path: str | Path, line_number: int, line: str) -> tuple[float, float]:
    try:
        x, y = map(number, line.split())
    except ValueError:
        raise DatasetError(f"{path}, line {line_number}: expected two numbers 'x y', found {line!r}") from None
    if not (np.isfinite([x, y]).all() or np.isnan([x, y]).all()):
        expected = "expected finite coordinates, or 'nan nan' for a missing point"
        raise DatasetError(f"{path}, line {line_number}: {expected}, found {line!r}")
    return x, y


def check_base(base: int) -> None:
    """Refuse another number of the first pixel than 0 and 1.

    Raises:
        InputError: it is another.
    """
    if base not in (0, 1):
        raise InputError(f"base is what the file calls the first pixel, 0 or 1; got {base}")


def _reason(error: Exception) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else "not UTF-8"
