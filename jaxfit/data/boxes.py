"""Face boxes: arrays (4,) float64 of x, y, width, height, in pixels."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxfit.data.inputs import read_text
from jaxfit.data.names import pictures_named
from jaxfit.data.numbers import number
from jaxfit.errors import InputError

_COLUMNS = ("image", "x", "y", "width", "height")
_ROTATION, _KIND = "rotation", "box"
_MOST_BYTES = 1 << 30  # of a file: some ten million rows
UNKNOWN_BOX = np.full(4, np.nan)  # of a face without a box
_SMALLEST, _LARGEST = 1e-3, 1e6  # sides of a box, in pixels; others are mistakes


def bounding_square(landmarks: np.ndarray) -> np.ndarray:
    """The square (4,) around the finite points of ``landmarks`` (L, 2): their rectangle, its shorter side grown.

    Raises:
        InputError: no point is finite.
    """
    known = landmarks[np.isfinite(landmarks).all(1)]
    if not len(known):
        raise InputError("a face needs at least one known landmark to have a box; got none")
    low, high = known.min(0), known.max(0)
    side = (high - low).max()
    return np.array([*((low + high - side) / 2), side, side])


def box_centre(box: np.ndarray) -> np.ndarray:
    """The centre (2,) of a box (4,)."""
    return box[:2] + box[2:] / 2


def jitter(box: np.ndarray, rng: np.random.Generator, shift: float = 0.06, scale: float = 0.08) -> np.ndarray:
    """A box (4,) as another detector might have drawn it.

    Args:
        box: (4,).
        rng: where the noise comes from.
        shift: standard deviation of the centre's move, in sides.
        scale: standard deviation of the logarithm of the factor on both sides.
    """
    centre = box_centre(box) + rng.normal(0, shift, 2) * box[2:]
    sides = box[2:] * np.exp(rng.normal(0, scale))
    return np.concatenate([centre - sides / 2, sides])


def box_problem(box: np.ndarray, image_shape: tuple[int, ...]) -> str | None:
    """Why no face can be looked for in a box (4,) of an image (H, W, …), as a sentence; None if one can."""
    height, width = image_shape[:2]
    x, y, box_width, box_height = box.tolist()
    if not all(map(math.isfinite, (x, y, box_width, box_height))):
        return "the face box has a coordinate that is not a finite number"
    if min(box_width, box_height) < _SMALLEST:
        return f"the face box has no area: width {box_width:g}, height {box_height:g}"
    if max(box_width, box_height) > _LARGEST:
        return f"the face box is over {_LARGEST:,.0f} pixels large: width {box_width:g}, height {box_height:g}"
    if x >= width or y >= height or x + box_width <= 0 or y + box_height <= 0:
        return f"the face box lies outside the {width} x {height} picture: x {x:g}, y {y:g}"
    return None


class GivenBox(NamedTuple):
    """A face box from a file.

    Attributes:
        box: (4,).
        rotation: how far the face is turned in the picture, in degrees, clockwise as seen.
        kind: what drew it; empty if the file does not say.
    """

    box: np.ndarray
    rotation: float
    kind: str = ""


def read_boxes(path: str | Path) -> dict[str, list[GivenBox]]:
    """Boxes by what the file calls the picture, from a CSV file with the columns image, x, y, width and height;
    rotation, in degrees, if faces are turned; and box, what drew it, if several detectors did.

    Columns may come in any order and beside others: the ``landmarks.csv`` of ``jaxfit fit`` is such a file. ``image``
    is a path, as `boxes_of_pictures` says.

    Raises:
        InputError: the file is missing, not CSV, lacks a column, or has a cell that is not a finite number.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_text(path, _MOST_BYTES), newline=""))
        missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise InputError(f"{path}, line 1: expected the columns {','.join(_COLUMNS)}; no {', '.join(missing)}")
        return _boxes(path, reader)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected a CSV file of face boxes in UTF-8; {error}; save it as UTF-8") from error
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: expected a CSV file of face boxes; {error}") from error


def _boxes(path: str | Path, reader: csv.DictReader) -> dict[str, list[GivenBox]]:
    columns = [*_COLUMNS[1:], *[_ROTATION] * (_ROTATION in (reader.fieldnames or ()))]
    boxes: dict[str, list[GivenBox]] = {}
    for row in reader:
        # A short row has None in its last cells.
        name = row["image"] or ""
        try:
            numbers = np.array([number(row[column]) for column in columns])
        except (ValueError, TypeError):
            numbers = np.full(4, np.nan)
        if not np.isfinite(numbers).all():
            cells = ", ".join(str(row[column]) for column in columns)
            raise InputError(
                f"{path}, line {reader.line_num}: expected finite numbers {', '.join(columns)}; got {cells}"
            )
        if not name.strip():
            raise InputError(f"{path}, line {reader.line_num}: expected the picture's file name; got none")
        rotation = float(numbers[4]) if len(numbers) > 4 else 0.0
        boxes.setdefault(name, []).append(GivenBox(numbers[:4], rotation, (row.get(_KIND) or "").strip()))
    return boxes


def boxes_of_pictures(
    named: Mapping[str, Sequence[GivenBox]], pictures: Iterable[Path], folders: Iterable[str | Path] = ()
) -> tuple[dict[Path, list[GivenBox]], list[str]]:
    """The boxes of each picture, from those that `read_boxes` gives by name, and the names that no picture has.

    Args:
        named: what the file calls pictures: paths, absolute, or relative to ``folders`` or the working folder, or ends
            of paths, such as bare file names, where only one picture's path ends so.
        pictures: that may be meant.
        folders: those that hold the file, and the pictures.

    Raises:
        InputError: a name may mean several pictures.
    """
    meant = pictures_named(named, pictures, folders)
    boxes: dict[Path, list[GivenBox]] = {}
    for name, several in meant.items():
        for picture in several:
            boxes.setdefault(picture, []).extend(named[name])
    return boxes, sorted(set(named) - set(meant))


def box_array(boxes: ArrayLike, count: int) -> np.ndarray:
    """Boxes as an array (N, 4), one for each of ``count`` pictures.

    Raises:
        InputError: they are none.
    """
    try:
        array = np.asarray(boxes, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"expected boxes as an array ({count}, 4) of numbers; got {boxes!r}") from None
    # No faces, no boxes: an empty list is as good as an empty (0, 4) array.
    if count == 0 and array.size == 0:
        return array.reshape(0, 4)
    if array.shape != (count, 4):
        raise InputError(
            f"expected one box (x, y, width, height) for each of {count} images, an array ({count}, 4); "
            f"got an array {array.shape}"
        )
    return array


def rotation_array(rotations: ArrayLike | None, count: int) -> np.ndarray:
    """Rotations as an array (N,), in degrees, one for each of ``count`` boxes; zeros for None.

    Raises:
        InputError: they are none, or not finite.
    """
    if rotations is None:
        return np.zeros(count)
    try:
        array = np.asarray(rotations, np.float64)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise InputError(f"expected a rotation in degrees for each of {count} boxes; got {rotations!r}")
    return array
