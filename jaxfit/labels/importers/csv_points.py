"""Landmarks in comma-separated values: in wide form, as ``landmarks.csv`` of ``jaxfit fit``, and in ml-morph's form."""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from jaxfit.errors import DatasetError
from jaxfit.labels.importers.annotations import (
    Annotation,
    annotation_text,
    coordinate,
    dataset_of,
    given_scale,
    named_scheme,
)
from jaxfit.labels.records import Dataset
from jaxfit.schemes.known import NO_LANDMARKS, scheme_named
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import ANGLES, DEFAULT_ORDER, PoseOrder

_BOX = ("x", "y", "width", "height")
_ORDER = "pose_order"  # the column of what angles mean
# What else `jaxfit fit` writes, which is about fits and not about labels.
_OF_FITS = ("box", "rotation", "ok", "confidence")
_ML_MORPH_BOX = ("box_left", "box_top", "box_width", "box_height")


def read_csv_points(file: str | Path) -> Dataset:
    """A table with a row an object: ``image``, then ``x1,y1,x2,y2,...`` or ``NAME_x,NAME_y,...``, in pixels, y down.

    Empty cells are missing points. ``v1`` or ``NAME_v``, where given, is 1 of hidden points, as in COCO. The columns
    ``x,y,width,height`` are a box, ``roll,pitch,yaw`` a pose in degrees, ``pose_order`` what its angles mean,
    ``scale`` the length of a pixel, ``subject`` and ``face`` names. Tables with poses may have no points. ``image`` is
    the picture's path from the file's folder. Rows that cannot be used, and columns that are not read, become problems.

    Raises:
        DatasetError: the file is missing, lacks columns, no row can be used, or no picture exists.
    """
    file = Path(file)
    scheme, annotations, problems = csv_annotations(file)
    return dataset_of(f"csv:{file}", file, annotations, problems, scheme=scheme)


def csv_annotations(file: Path) -> tuple[Scheme, list[Annotation], list[str]]:
    """What the landmarks of such a table mean, its rows, and the problems of those that cannot be used, wherever their
    pictures are.

    Raises:
        DatasetError: the file is missing, or lacks columns.
    """
    header, rows = _table(file)
    if "image" not in header:
        hint = "; if it is ml-morph's, whose y counts from the bottom, say ml-morph:" if _is_ml_morph(header) else ""
        raise DatasetError(f"{file}, line 1: expected a column image, and x1, y1, ...; got {_some(header)}{hint}")
    boxed, posed = (all(name in header for name in columns) for columns in (_BOX, ANGLES))
    names, columns = _point_columns(file, header, posed)
    read = {
        "image",
        "scale",
        "subject",
        "face",
        *_OF_FITS,
        *(_BOX if boxed else ()),
        *((*ANGLES, _ORDER) if posed else ()),
        *(c for each in columns for c in each),
    }
    others = [name for name in header if name not in read]
    problems = [f"{file}: the columns {_some(others)} are not read"] if others else []
    annotations = []
    for where, cells in rows:
        row = dict(zip(header, cells, strict=True))
        try:
            annotations.append(_wide(where, row, columns, boxed, posed, problems))
        except DatasetError as error:
            problems.append(f"{where}: {error}")
    numbered = scheme_named(f"points{len(columns)}") if columns else NO_LANDMARKS
    return named_scheme(file, names) if names else numbered, annotations, problems


def read_ml_morph(file: str | Path, stored: bool = False) -> Dataset:
    """A table in ml-morph's form: the picture's name in the first column, then x and y of all landmarks, in which y
    counts from the bottom of the picture, as in TPS files.

    What ml-morph makes of its predictions is read, too: it has the columns ``box_top``, ``box_left``, ``box_width`` and
    ``box_height``, and y counts from the top.

    Args:
        file: the file.
        stored: whether y counts in the pixels as they are stored, whatever EXIF data say.

    Raises:
        DatasetError: as `read_csv_points`.
    """
    file = Path(file)
    header, rows = _table(file)
    predicted = all(name in header for name in _ML_MORPH_BOX)
    points = [place for place, name in enumerate(header) if place and not name.startswith("box_")]
    pairs = list(zip(points[::2], points[1::2], strict=False))
    good = len(points) % 2 == 0 and all(header[one][:1] in "xX" and header[other][:1] in "yY" for one, other in pairs)
    if not pairs or not good:
        raise DatasetError(f"{file}, line 1: expected the columns id,X1,Y1,X2,Y2,...; got {_some(header)}")
    annotations, problems = [], []
    for where, cells in rows:
        try:
            box = None
            if predicted:
                box = _numbers(cells, header, [header.index(name) for name in _ML_MORPH_BOX])
            landmarks = np.stack([_numbers(cells, header, pair) for pair in pairs])
            image = cells[0].strip()
            if not image:
                raise DatasetError("expected a picture's name in the first column; got none")
            annotations.append(Annotation(where, image, landmarks, box=box))
        except DatasetError as error:
            problems.append(f"{where}: {error}")
    spec = f"ml-morph:{file}"
    return dataset_of(spec, file, annotations, problems, from_bottom=not predicted, stored=stored)


def _table(file: Path) -> tuple[list[str], Iterator[tuple[str, list[str]]]]:
    """The header of a table, and its rows with their places."""
    text = annotation_text(file, "a CSV table of landmarks")
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        header = [name.strip() for name in next(reader, [])]
        rows = [(f"{file}, line {reader.line_num}", cells) for cells in reader if any(cells)]
    except csv.Error as error:
        raise DatasetError(f"{file}, line {reader.line_num}: expected a CSV table of landmarks; {error}") from None
    if not header:
        raise DatasetError(f"{file}: expected a CSV table of landmarks; it is empty")
    if repeated := [name for name in dict.fromkeys(header) if header.count(name) > 1]:
        raise DatasetError(f"{file}, line 1: expected columns of different names; {_some(repeated)} come twice")
    # A short row lacks its last cells: of points, these are missing ones.
    return header, ((where, (cells + [""] * len(header))[: len(header)]) for where, cells in rows)


def _is_ml_morph(header: Sequence[str]) -> bool:
    return any(re.fullmatch("X[01]", name) for name in header)


def _point_columns(
    file: Path, header: Sequence[str], posed: bool
) -> tuple[tuple[str, ...], list[tuple[str, str, str]]]:
    """The names of the points, empty if they are numbered, and their columns x, y and v, which may not be there; of
    tables with poses, there may be none."""
    numbers = sorted(int(found[1]) for name in header if (found := re.fullmatch("x([0-9]{1,6})", name)))
    if numbers:
        names: tuple[str, ...] = ()
        columns = [(f"x{number}", f"y{number}", f"v{number}") for number in numbers]
        if numbers[0] not in (0, 1) or numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            raise DatasetError(f"{file}, line 1: expected points numbered one after the other; got x{numbers}"[:200])
    else:
        names = tuple(name[:-2] for name in header if name.endswith("_x") and len(name) > 2)
        columns = [(f"{name}_x", f"{name}_y", f"{name}_v") for name in names]
    if posed and not columns:
        return (), []
    if not columns or (lacking := [across for across, down, _ in columns if down not in header]):
        lack = f"{lacking[0]} without its y" if columns else f"{_some(header)}"
        raise DatasetError(f"{file}, line 1: expected the columns x1,y1,x2,y2,... or NAME_x,NAME_y,...; got {lack}")
    return names, columns


def _wide(
    where: str,
    row: dict[str, str],
    columns: Sequence[tuple[str, str, str]],
    boxed: bool,
    posed: bool,
    problems: list[str],
) -> Annotation:
    if not row["image"].strip():
        raise DatasetError("expected a picture's path in the column image; got none")
    landmarks = np.array([[_number(row, across), _number(row, down)] for across, down, _ in columns]).reshape(-1, 2)
    visible = np.array([row.get(state, "").strip() != "1" for _, _, state in columns], bool)
    box = np.array([_number(row, name) for name in _BOX]) if boxed else None
    if box is not None and not np.isfinite(box).all():
        if np.isfinite(box).any():
            raise DatasetError(f"expected all of {', '.join(_BOX)}, or none; got some")
        box = None
    scale = given_scale(_number(row, "scale"), where, problems) if "scale" in row else None
    pose = np.array([_number(row, angle) for angle in ANGLES]) if posed else None
    orders: dict[str, PoseOrder] = {order: order for order in get_args(PoseOrder)} | {"": DEFAULT_ORDER}
    order = row.get(_ORDER, "").strip() if posed else ""
    if order not in orders:
        raise DatasetError(f"expected a {_ORDER} of {' or '.join(get_args(PoseOrder))}; got {order[:80]!r}")
    return Annotation(
        where,
        row["image"],
        landmarks,
        face=row.get("face", "").strip(),
        visible=visible,
        box=box,
        scale=scale,
        subject=row.get("subject", "").strip(),
        pose=None if pose is None or np.isnan(pose).all() else pose,
        pose_order=orders[order],
    )


def _numbers(cells: Sequence[str], header: Sequence[str], places: Sequence[int]) -> np.ndarray:
    row = dict(zip(header, cells, strict=True))
    return np.array([_number(row, header[place]) for place in places])


def _number(row: dict[str, str], name: str) -> float:
    try:
        return coordinate(row[name])
    except ValueError:
        raise DatasetError(f"{name}: expected a number, or nothing; got {row[name][:80]!r}") from None


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
