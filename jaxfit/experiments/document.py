"""What a report is made of: sections of text, tables, figures and a gallery of faces, whatever they are rendered to."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jaxfit.errors import InputError
from jaxfit.evaluation.tables import Row

if TYPE_CHECKING:
    import matplotlib.figure

_NAME = re.compile(r"[A-Za-z0-9]+([._-][A-Za-z0-9]+)*")  # a file's on every system


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: stem of its files, such as ``"table-3"``.
        title: what stands above it.
        columns: for each heading, in order, how its floats are formatted, such as ``.4f``; ``""`` for plain.
        rows: values by heading; a missing one, None or NaN shows as a dash.
        note: what stands below it.
    """

    name: str
    title: str
    columns: Mapping[str, str]
    rows: tuple[Row, ...]
    note: str = ""


@dataclass(frozen=True)
class Figure:
    """A figure of matplotlib's.

    Attributes:
        name: stem of its files, such as ``"figure-12"``.
        title: what stands above it.
        figure: what is drawn.
        note: what stands below it.
    """

    name: str
    title: str
    figure: "matplotlib.figure.Figure"
    note: str = ""


@dataclass(frozen=True)
class GalleryFace:
    """A labelled face with its fits, in the pixels of its thumbnail.

    Attributes:
        dataset: its name.
        face: identifies it within the dataset.
        size: side of the (square) thumbnail in pixels.
        jpeg: the thumbnail; None draws the landmarks on an empty ground.
        truth: (L, 2) the labels.
        fits: by method, (L, 2) fitted landmarks, NaN where there is none.
        errors: by method, the NMED; ``inf`` where there is no fit.
        yaw: of the head in degrees, NaN if unknown.
        pitch: likewise.
    """

    dataset: str
    face: str
    size: int
    jpeg: bytes | None
    truth: np.ndarray
    fits: Mapping[str, np.ndarray]
    errors: Mapping[str, float]
    yaw: float
    pitch: float


@dataclass(frozen=True)
class Gallery:
    """Faces to look through.

    Attributes:
        title: what stands above them.
        faces: in any order.
        lines: by dataset, which landmarks lines join, as ``Scheme.lines``.
        note: what stands below them.
    """

    title: str
    faces: tuple[GalleryFace, ...]
    lines: Mapping[str, tuple[tuple[int, ...], ...]]
    note: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a report under a heading.

    Attributes:
        title: the heading.
        text: paragraphs of plain text below it.
        parts: what follows, in order.
    """

    title: str
    text: tuple[str, ...] = ()
    parts: tuple[Table | Figure | Gallery, ...] = ()


@dataclass(frozen=True)
class Document:
    """A report.

    Attributes:
        title: its title.
        about: short facts below the title by what they tell: versions, the machine, dates, what was run.
        sections: in order.
    """

    title: str
    about: Mapping[str, str] = field(default_factory=dict)
    sections: tuple[Section, ...] = ()


def check_names(names: Sequence[str], where: str) -> None:
    """Check that names can name files, next to one another.

    Raises:
        InputError: they cannot.
    """
    seen = set()
    for name in names:
        if not _NAME.fullmatch(name):
            raise InputError(
                f"{where}: expected a name of letters and digits with single '.', '_' or '-' between them, as it goes "
                f"into file names; got {name!r}"
            )
        if name.casefold() in seen:  # some file systems do not tell case
            raise InputError(f"{where}: two are called {name}; give each a name of its own")
        seen.add(name.casefold())
