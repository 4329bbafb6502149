"""XML files of dlib's imglab: pictures with boxes and, in them, parts; ml-morph's are like them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from jaxfit.data.inputs import read_regular
from jaxfit.data.numbers import number
from jaxfit.errors import DatasetError
from jaxfit.labels.importers.annotations import MOST_BYTES, Annotation, dataset_of, named_scheme
from jaxfit.labels.records import Dataset

_DEEPEST = 100  # elements in one another; imglab's are five
_MOST_PARTS = 100_000
_SIDES = ("left", "top", "width", "height")


@dataclass
class _Box:
    where: str
    image: str
    attributes: dict[str, str]
    parts: dict[str, tuple[float, float]] = field(default_factory=dict)
    problem: str = ""


class _Handler:
    """Collects boxes while a file is parsed. Entities, with which a small file can stand for gigabytes, are refused."""

    def __init__(self, file: Path):
        self.file = file
        self.boxes: list[_Box] = []
        self.problems: list[str] = []
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.EntityDeclHandler = self._entity
        self._open: list[str] = []
        self._image = ""

    @property
    def _where(self) -> str:
        return f"{self.file}, line {self.parser.CurrentLineNumber}"

    def _entity(self, name: str, *rest: Any) -> None:
        raise DatasetError(f"{self._where}: expected no entities, which imglab does not write; got {name!r}")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if not self._open and name != "dataset":
            raise DatasetError(f"{self._where}: expected imglab's <dataset>; got <{name[:80]}>")
        self._open.append(name)
        if len(self._open) > _DEEPEST:
            raise DatasetError(f"{self._where}: expected imglab's XML; its elements are nested too deeply")
        if name == "image":
            self._image = attributes.get("file", "")
            if not self._image:
                self.problems.append(f"{self._where}: the image names no file")
        elif name == "box":
            self.boxes.append(_Box(self._where, self._image, attributes))
        elif name == "part" and "box" in self._open:
            self._part(self.boxes[-1], attributes)

    def _part(self, box: _Box, attributes: dict[str, str]) -> None:
        try:
            name, point = attributes["name"], (number(attributes["x"]), number(attributes["y"]))
            if not np.isfinite(point).all() or name in box.parts:
                raise ValueError
            box.parts[name] = point
        except (KeyError, ValueError):
            said = " ".join(f"{key}={value!r}" for key, value in attributes.items())
            box.problem = box.problem or f"{self._where}: expected a part with a new name and numbers x, y; got {said}"

    def _end(self, name: str) -> None:
        self._open.pop()


def read_imglab(file: str | Path) -> Dataset:
    """The boxes of an imglab file that have parts or could have; ``file`` is the picture's path from the file's folder.

    Landmarks are the parts of all boxes, by name: in the order of their numbers, or of their names as dlib has them.
    Those that a box lacks are missing. Boxes that are to be ignored become problems.

    Raises:
        DatasetError: the file is missing, not imglab's XML, has entities, no box can be used, or no picture exists.
    """
    file = Path(file)
    handler = _Handler(file)
    try:
        handler.parser.Parse(read_regular(file, MOST_BYTES), True)
    except (OSError, ValueError, LookupError) as error:
        why = getattr(error, "strerror", None) or error
        raise DatasetError(f"{file}: expected imglab's XML; {why}") from error
    except expat.ExpatError as error:
        why = expat.ErrorString(error.code)
        raise DatasetError(f"{file}, line {error.lineno}: expected imglab's XML; {why}") from None
    names = _ordered({name for box in handler.boxes for name in box.parts})
    if len(names) > _MOST_PARTS:
        raise DatasetError(f"{file}: expected at most {_MOST_PARTS:,} different parts; got {len(names):,}")
    places = {name: place for place, name in enumerate(names)}
    annotations, problems = [], handler.problems
    for box in handler.boxes:
        try:
            annotations.append(_annotation(box, places))
        except DatasetError as error:
            problems.append(str(error))
    if not names:
        raise DatasetError(f"{file}: expected boxes with parts, <part name='...' x='...' y='...'/>; got none")
    scheme = named_scheme(file, names)
    return dataset_of(f"imglab:{file}", file, annotations, problems, scheme=scheme)


def _ordered(names: set[str]) -> list[str]:
    if all(name.isascii() and name.isdecimal() and len(name) < 10 for name in names):
        return sorted(names, key=lambda name: (int(name), name))
    return sorted(names)


def _annotation(box: _Box, places: dict[str, int]) -> Annotation:
    if box.problem:
        raise DatasetError(box.problem)
    if not box.image:
        raise DatasetError(f"{box.where}: its image names no file")
    if box.attributes.get("ignore") in ("1", "true"):
        raise DatasetError(f"{box.where}: the box is marked to be ignored")
    try:
        sides = np.array([number(box.attributes[side]) for side in _SIDES])
        if not np.isfinite(sides).all() or (sides[2:] <= 0).any():
            raise ValueError
    except (KeyError, ValueError):
        got = " ".join(f"{side}={box.attributes.get(side)!r}" for side in _SIDES)
        raise DatasetError(f"{box.where}: expected a box with numbers {', '.join(_SIDES)}; got {got}") from None
    landmarks = np.full((len(places), 2), np.nan)
    for name, point in box.parts.items():
        landmarks[places[name]] = point
    return Annotation(box.where, box.image, landmarks, box=sides)
