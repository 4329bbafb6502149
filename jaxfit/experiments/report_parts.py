"""What a report is made of: sections of text, tables, figures and a gallery of faces, whatever they are written as."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jaxfit.evaluation.tables import Row

if TYPE_CHECKING:
    import matplotlib.figure


@dataclass(frozen=True)
class ReportTable:
    """A table.

    Attributes:
        name: stem of its files, such as ``"errors-2d"``.
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
class ReportFigure:
    """A figure of matplotlib's.

    Attributes:
        name: stem of its files, such as ``"grid-faces-2d"``.
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
        name: identifies it among the parts of a report.
    """

    title: str
    faces: tuple[GalleryFace, ...]
    lines: Mapping[str, tuple[tuple[int, ...], ...]]
    note: str = ""
    name: str = "gallery"


Part = ReportTable | ReportFigure | Gallery


@dataclass(frozen=True)
class Section:
    """A part of a report under a heading.

    Attributes:
        title: the heading.
        text: paragraphs of plain text below it.
        parts: what follows, in order.
        name: identifies the section, whatever its title.
    """

    title: str
    text: tuple[str, ...] = ()
    parts: tuple[Part, ...] = ()
    name: str = ""


@dataclass(frozen=True)
class Report:
    """A report.

    Attributes:
        title: its title.
        about: short facts below the title, by what they are about: versions, the machine, dates, what was run.
        sections: in order.
    """

    title: str
    about: Mapping[str, str] = field(default_factory=dict)
    sections: tuple[Section, ...] = ()
