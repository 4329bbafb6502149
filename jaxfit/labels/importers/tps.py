"""TPS files, as tpsDig writes and geomorph reads them: specimens with landmarks, whose y counts from the bottom."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from jaxfit.data.inputs import read_regular
from jaxfit.data.numbers import number, whole_number
from jaxfit.errors import DatasetError
from jaxfit.labels.importers.annotations import MOST_BYTES, Annotation, coordinate, dataset_of, given_scale
from jaxfit.labels.records import Dataset

_MOST_POINTS = 100_000


@dataclass
class _Specimen:
    line: int
    count: int
    solid: bool = False  # landmarks in 3D
    points: list[tuple[float, ...]] = field(default_factory=list)
    values: dict[str, str] = field(default_factory=dict)
    problem: str = ""


def read_tps(file: str | Path, stored: bool = False) -> Dataset:
    """The specimens of a TPS file, whose ``IMAGE`` is the picture's path, or name, from the file's folder.

    y counts from the bottom of the picture: the row is height - y, so that the picture has to be there. Points ``NA``,
    and points of two negative numbers, are missing. ``SCALE`` is the length of a pixel. Specimens without landmarks or
    picture, or with landmarks in 3D, become problems; of curves, outlines and comments a problem says that they are not
    read.

    Args:
        file: the file.
        stored: whether y counts in the pixels as they are stored, whatever EXIF data say.

    Raises:
        DatasetError: the file is missing, no specimen can be used, or no picture exists.
    """
    file = Path(file)
    annotations: list[Annotation] = []
    problems: list[str] = []
    unread: Counter[str] = Counter()
    for specimen in _specimens(file, _lines(file), problems, unread):
        where = f"{file}, line {specimen.line}"
        if problem := specimen.problem or _problem(specimen):
            problems.append(f"{where}: {problem}")
            continue
        landmarks = np.array(specimen.points)
        landmarks[(landmarks < 0).all(1)] = np.nan
        scale = None
        if text := specimen.values.get("SCALE"):
            try:
                scale = given_scale(number(text), where, problems)
            except ValueError:
                problems.append(f"{where}: expected SCALE=NUMBER; got SCALE={text}: it is left out")
        annotations.append(
            Annotation(where, specimen.values["IMAGE"], landmarks, face=specimen.values.get("ID", ""), scale=scale)
        )
    problems += [f"{file}: {key} of {times} specimens: only landmarks are read" for key, times in unread.items()]
    return dataset_of(f"tps:{file}", file, annotations, problems, from_bottom=True, stored=stored)


def _lines(file: Path) -> list[str]:
    """The lines of a file in UTF-8, or in what Windows used before."""
    try:
        data = read_regular(file, MOST_BYTES)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{file}: expected a TPS file; {getattr(error, 'strerror', None) or error}") from error
    try:
        return data.decode("utf-8-sig").replace("\r", "\n").split("\n")
    except UnicodeDecodeError:
        return data.decode("latin-1").replace("\r", "\n").split("\n")


def _specimens(file: Path, lines: list[str], problems: list[str], unread: Counter[str]) -> Iterator[_Specimen]:
    """The specimens, from ``LM=`` to ``LM=``; ``unread`` counts what else they have."""
    specimen: _Specimen | None = None
    curve = 0  # points of a curve that are still to come
    for line_number, line in enumerate(map(str.strip, lines), 1):
        if not line:
            continue
        key, equals, value = line.partition("=")
        key, value = key.strip().upper(), value.strip()
        if equals and key in ("LM", "LM3"):
            if specimen:
                yield specimen
            curve = 0
            specimen = _Specimen(line_number, 0, solid=key == "LM3")
            try:
                specimen.count = whole_number(value)
            except ValueError:
                specimen.problem = f"expected {key}=NUMBER of landmarks; got {line!r}"
        elif specimen is None:
            problems.append(f"{file}, line {line_number}: expected LM=NUMBER before all else; got {line[:80]!r}")
        elif equals:
            specimen.values.setdefault(key, value)
            if key == "POINTS":
                curve = int(value) if value.isdecimal() and len(value) < 10 else 0
            elif key not in ("IMAGE", "ID", "SCALE"):
                unread[key] += 1
        elif curve:
            curve -= 1
        elif len(specimen.points) < specimen.count:
            try:
                specimen.points.append(tuple(map(coordinate, line.split())))
            except ValueError:
                comma = "; numbers need points, not commas" if "," in line else ""
                specimen.problem = specimen.problem or f"line {line_number}: expected 'x y'; got {line[:80]!r}{comma}"
                specimen.points.append((np.nan, np.nan))
        else:
            specimen.problem = specimen.problem or (
                f"line {line_number}: expected KEY=VALUE after {specimen.count} points; got {line[:80]!r}"
            )
    if specimen:
        yield specimen


def _problem(specimen: _Specimen) -> str:
    """Why a specimen cannot be used; empty if it can."""
    if specimen.solid:
        return "landmarks in 3D (LM3=), expected LM= with x and y in a picture"
    if not 0 < specimen.count <= _MOST_POINTS:
        return f"LM={specimen.count}: expected landmarks, 1 to {_MOST_POINTS}"
    if len(specimen.points) != specimen.count:
        return f"says LM={specimen.count}, but lists {len(specimen.points)} points"
    if odd := next((point for point in specimen.points if len(point) != 2), None):
        return f"expected two numbers 'x y' a point; got {len(odd)}"
    if not specimen.values.get("IMAGE"):
        return "names no picture: expected IMAGE=NAME"
    return ""
