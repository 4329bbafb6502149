"""Results as tables: of landmarks, and for 3D models of heads; a row a face."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxfit.data.fitted import FittedFace
from jaxfit.data.writers.writer import Results
from jaxfit.evaluation.pose import ANGLES

TEXTS = ("image", "face", "box")  # columns of words; all others are of numbers


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: of its file, without a suffix.
        columns: their names.
        row: a face's values; None where there is none.
    """

    name: str
    columns: tuple[str, ...]
    row: Callable[[FittedFace], list[str | float | None]]


def tables_of(results: Results) -> list[Table]:
    """The tables that there are of some results."""
    tables = [_landmarks(results)]
    return tables if results.modes is None else [*tables, _heads(results, results.modes)]


def _landmarks(results: Results) -> Table:
    points = [f"{axis}{i}" for i in range(1, results.scheme.count + 1) for axis in "xy"]
    told = ["confidence"] if results.confident else []

    def row(face: FittedFace) -> list[str | float | None]:
        confidence = [face.confidence] if results.confident else []
        return [face.image, face.face, face.kind, *face.box, *confidence, *face.landmarks]

    return Table("landmarks", (*TEXTS, "x", "y", "width", "height", *told, *points), row)


def _heads(results: Results, modes: int) -> Table:
    points = [f"{axis}{i}" for i in range(1, results.scheme.count + 1) for axis in "xyz"]

    def row(face: FittedFace) -> list[str | float | None]:
        return [face.image, face.face, *(face.pose or ()), face.scale, *(face.landmarks_3d or ()), *(face.b or ())]

    return Table("heads", (*TEXTS[:2], *ANGLES, "scale", *points, *(f"b{i + 1}" for i in range(modes))), row)
