"""Fitted faces as rows: nested plain values, as JSON lines have them, and flat ones, as tables have them."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np

from jaxfit.data.names import table_path, table_word
from jaxfit.schemes.openness import openings_of
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import ANGLES

# A face as plain JSON values: image, face, size, box, ok, landmarks; openness, by what opens, of schemes with lids and
# lips; confidence, if the model has one; pose, scale, landmarks_3d and b of 3D models; position, in millimetres, and
# rotation_vector before a camera that is known; covariances, [xx, xy, yy] a landmark in squares of pixels, and visible,
# a probability a landmark, of models that know these. Other lengths are in pixels of the picture. Rows of labels, which
# only writers of annotations take, may lack size and box; points may be [None, None]; hidden (a flag a point), pixel
# and subject may be there.
Row = dict[str, Any]

PROBLEM = "problem"  # the key, and the column, of why a face or a picture has no fit
TEXTS = ("image", "face", "box", PROBLEM)  # columns of words; all others are of numbers
HEAD = "head_"  # before the columns of heads, in tables that have both
PLACE = tuple(f"{what}_{axis}" for what in ("position", "rotation") for axis in "xyz")  # before a camera
_BOX = ("x", "y", "width", "height", "rotation")
_DOUBTS = ("deviation", "visible")  # before the numbers of landmarks, in the names of columns
_OPENNESS = "_openness"  # behind what opens, in the names of columns
PIXEL = "pixel"  # the key of the length of a pixel in units, in rows of labels
FLAGS = ("ok",)  # columns of yes and no
_DIGITS = 3  # after the point


@dataclass(frozen=True)
class Rows:
    """The rows of all faces that one model fitted, in the order of their pictures; they can be iterated repeatedly.

    Attributes:
        scheme: what the landmarks mean.
        modes: number of coefficients of the 3D shape model; None for models without 3D.
        confident: whether the model has a confidence.
        begin: starts an iteration.
        placed: whether heads have a place before a camera.
        uncertain: whether the model says how far landmarks may be off, and whether they can be seen.
        failures: of writers: pictures of which something could not be written, and why; writers add to it.
    """

    scheme: Scheme
    modes: int | None
    confident: bool
    begin: Callable[[], Iterator[Row]]
    placed: bool = False
    uncertain: bool = False
    failures: list[tuple[str, str]] = field(default_factory=list, compare=False)

    def __iter__(self) -> Iterator[Row]:
        return self.begin()

    def only(self, wanted: Callable[[Row], bool]) -> "Rows":
        """Those rows of which ``wanted`` is true."""
        return replace(self, begin=lambda: filter(wanted, self.begin()))

    def tables(self) -> dict[str, tuple[str, ...]]:
        """The columns of each table, by the name of its file without a suffix."""
        tables = {"landmarks": landmark_columns(self.scheme, self.confident, self.uncertain)}
        return tables if self.modes is None else tables | {"heads": head_columns(self.scheme, self.modes, self.placed)}


def rounded(values: np.ndarray | np.floating) -> Any:
    """Numbers as they are written: floats, or lists of them, rounded to thousandths."""
    return np.round(np.asarray(values, np.float64), _DIGITS).tolist()


def landmark_columns(scheme: Scheme, confident: bool, uncertain: bool = False) -> tuple[str, ...]:
    """The columns of ``landmarks.csv``; of each landmark, ``deviation`` is the root of its mean variance in x and y."""
    points = [f"{axis}{number}" for number in range(1, scheme.count + 1) for axis in "xy"]
    opened = (f"{opening.name}{_OPENNESS}" for opening in openings_of(scheme))
    doubts = (f"{what}{number}" for what in _DOUBTS for number in range(1, scheme.count + 1)) if uncertain else ()
    return (*TEXTS[:3], *_BOX, *FLAGS, *["confidence"] * confident, *points, *opened, *doubts)


def head_columns(scheme: Scheme, modes: int, placed: bool = False) -> tuple[str, ...]:
    """The columns of ``heads.csv``."""
    points = [f"{axis}{number}" for number in range(1, scheme.count + 1) for axis in "xyz"]
    coefficients = (f"b{number}" for number in range(1, modes + 1))
    return (*TEXTS[:2], *FLAGS, *ANGLES, "scale", *points, *coefficients, *(PLACE if placed else ()))


def columns_of(
    scheme: Scheme, modes: int | None, confident: bool, placed: bool = False, uncertain: bool = False
) -> tuple[str, ...]:
    """The columns of both tables, those of heads, but the names, with ``head_`` before them."""
    heads = () if modes is None else head_columns(scheme, modes, placed)[3:]
    return (*landmark_columns(scheme, confident, uncertain), *(f"{HEAD}{name}" for name in heads))


def flat_row(row: Row) -> dict[str, Any]:
    """A row with the columns of `columns_of`."""
    flat: dict[str, Any] = {"image": row["image"], "face": row.get("face", "")}
    box = row.get("box", {})
    flat |= {"box": box.get("kind", ""), **{name: box[name] for name in _BOX if name in box}}
    if "ok" in row:
        flat["ok"] = row["ok"]
    if "confidence" in row:
        flat["confidence"] = row["confidence"]
    for number, (x, y) in enumerate(row.get("landmarks", ()), 1):
        flat[f"x{number}"], flat[f"y{number}"] = x, y
    flat |= {f"{name}{_OPENNESS}": value for name, value in row.get("openness", {}).items()}
    if "visible" in row:
        count = len(row["visible"])
        names = (f"{what}{number}" for what in _DOUBTS for number in range(1, count + 1))
        flat |= dict(zip(names, _doubts_of(row), strict=True))
    if "pose" in row:
        flat |= {f"{HEAD}{angle}": degrees for angle, degrees in row["pose"].items()}
        flat[f"{HEAD}scale"] = row["scale"]
        for number, (x, y, z) in enumerate(row["landmarks_3d"], 1):
            flat[f"{HEAD}x{number}"], flat[f"{HEAD}y{number}"], flat[f"{HEAD}z{number}"] = x, y, z
        flat |= {f"{HEAD}b{number}": value for number, value in enumerate(row["b"], 1)}
    if "position" in row:
        flat |= dict(zip((f"{HEAD}{name}" for name in PLACE), _place_of(row), strict=True))
    return flat


def _place_of(row: Row) -> list[float]:
    """The values of ``PLACE``; none of a row without them."""
    return [*row.get("position", ()), *row.get("rotation_vector", ())]


def _doubts_of(row: Row) -> list[float]:
    """The values of the columns of ``_DOUBTS``; none of a row without them."""
    deviations = [round(math.sqrt(max(xx + yy, 0.0) / 2), _DIGITS) for xx, _, yy in row.get("covariances", ())]
    return [*deviations, *row.get("visible", ())]


def spelled(row: Row) -> Row:
    """A row with the names of its picture and face as tables spell them, which are valid UTF-8 on one line."""
    return row | {"image": table_path(row["image"]), "face": table_word(row["face"])}


def table_values(name: str, row: Row) -> list[str | float | bool]:
    """The values of a row in the table ``landmarks`` or ``heads``, in the order of its columns."""
    row = spelled(row)
    if name == "landmarks":
        box = row["box"]
        confidence = [row["confidence"]] if "confidence" in row else []
        values = [row["image"], row["face"], box["kind"], *(box[side] for side in _BOX), row["ok"], *confidence]
        points = chain.from_iterable(row["landmarks"])
        return [*values, *points, *row.get("openness", {}).values(), *_doubts_of(row)]
    points = chain.from_iterable(row["landmarks_3d"])
    return [
        row["image"],
        row["face"],
        row["ok"],
        *row["pose"].values(),
        row["scale"],
        *points,
        *row["b"],
        *_place_of(row),
    ]


def table_text(value: str | float | bool) -> str:
    """A value as tables of text have it: numbers with three digits after the point, yes and no as 1 and 0."""
    if isinstance(value, bool):
        return str(int(value))
    return value if isinstance(value, str) else f"{value:.{_DIGITS}f}"
