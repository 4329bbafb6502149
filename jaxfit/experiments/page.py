"""A report as files: a page for browsers that needs nothing else, and its tables and figures on their own."""

import base64
import importlib.resources
import math
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfit.data.outputs import atomic_write, write_csv
from jaxfit.errors import InputError
from jaxfit.evaluation.tables import format_cells, is_numeric
from jaxfit.experiments.latex import latex_table
from jaxfit.experiments.markdown import markdown_text
from jaxfit.experiments.names import check_names
from jaxfit.experiments.report_parts import Gallery, GalleryFace, Part, Report, ReportFigure, ReportTable
from jaxfit.experiments.svg import write_figure

if TYPE_CHECKING:
    import jinja2

_WIDE_FIGURE = 8.5  # inches; narrower figures may stand side by side


def write_files(report: Report, folder: Path) -> list[str]:
    """Write a report: ``report.html``, ``report.md``, and the files of its tables (CSV, LaTeX) and figures (SVG, PNG);
    returns their paths in the folder.

    ``report.html`` needs no other file and no network. The others are ``tables/NAME.csv``, ``tables/NAME.tex``,
    ``figures/NAME.svg`` and ``figures/NAME.png``. The same report gives the same bytes. Figures are closed.

    Args:
        report: what is written.
        folder: where to; it is made if needed, and other files in it stay.

    Raises:
        InputError: jinja2 is missing, or the names of tables or figures are not file names or not unique.
    """
    template = _template()
    parts = [part for section in report.sections for part in section.parts]
    check_names([part.name for part in parts if isinstance(part, ReportTable)], "tables")
    check_names([part.name for part in parts if isinstance(part, ReportFigure)], "figures")
    for name in ("tables", "figures"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    sections = [
        {"title": section.title, "text": section.text, "parts": [_part(part, folder) for part in section.parts]}
        for section in report.sections
    ]
    with atomic_write(folder / "report.html", "w") as file:
        file.write(template.render(title=report.title, about=report.about, sections=sections))
    with atomic_write(folder / "report.md", "w") as file:
        file.write(markdown_text(report))
    written = ["report.html", "report.md"]
    for part in parts:
        if isinstance(part, ReportTable):
            written += [f"tables/{part.name}.{suffix}" for suffix in ("csv", "tex")]
        elif isinstance(part, ReportFigure):
            written += [f"figures/{part.name}.{suffix}" for suffix in ("svg", "png")]
    return written


def require_page_makers() -> None:
    """Check, before the work, that a page with its figures can be written.

    Raises:
        InputError: matplotlib or jinja2 is missing.
    """
    if missing := [name for name in ("jinja2", "matplotlib") if find_spec(name) is None]:
        raise InputError(f'pages of results need {" and ".join(missing)}: pip install "jaxfit[experiments]"')


def _template() -> "jinja2.Template":
    try:
        import jinja2
    except ImportError as error:
        raise InputError('reports need jinja2: pip install "jaxfit[experiments]"') from error
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    source = importlib.resources.files("jaxfit.experiments").joinpath("report.html.jinja")
    return environment.from_string(source.read_text(encoding="utf-8"))


def _part(part: Part, folder: Path) -> dict[str, Any]:
    """What the template shows of a part; the part's files are written."""
    if isinstance(part, ReportTable):
        _write_table(part, folder / "tables")
        return _table(part)
    if isinstance(part, ReportFigure):
        basis = "100%" if part.figure.get_figwidth() > _WIDE_FIGURE else "26rem"
        svg = write_figure(part, folder / "figures")
        return {"kind": "figure", "name": part.name, "title": part.title, "note": part.note, "svg": svg, "basis": basis}
    return _gallery(part)


def _write_table(table: ReportTable, folder: Path) -> None:
    """Write ``NAME.csv``, with the numbers as they are, and ``NAME.tex``, with the numbers as they are shown."""
    rows = ([row.get(heading) for heading in table.columns] for row in table.rows)
    write_csv(folder / f"{table.name}.csv", list(table.columns), rows)
    with atomic_write(folder / f"{table.name}.tex", "w") as file:
        file.write(latex_table(table))


def _table(table: ReportTable) -> dict[str, Any]:
    cells = format_cells(table.rows, table.columns)
    lengths = [max(map(len, column)) + 2 for column in zip(table.columns, *cells, strict=True)]  # with a gap
    return {
        "kind": "table",
        "name": table.name,
        "title": table.title,
        "note": table.note,
        "basis": f"{2 + sum(lengths) / 2:g}rem",  # about as wide as its letters
        "columns": [(heading, is_numeric(table.rows, heading)) for heading in table.columns],
        "rows": [
            [(text, _sort_key(row.get(heading), text)) for text, heading in zip(texts, table.columns, strict=True)]
            for texts, row in zip(cells, table.rows, strict=True)
        ],
    }


def _sort_key(value: object, text: str) -> str | None:
    """What a cell is sorted by, in the spelling of JavaScript; None if it misses its value."""
    if value is None or (isinstance(value, float | np.floating) and math.isnan(value)):
        return None
    if isinstance(value, int | float | np.number):
        return repr(float(value)).replace("inf", "Infinity")
    return text


def _gallery(gallery: Gallery) -> dict[str, Any]:
    datasets = list(dict.fromkeys(face.dataset for face in gallery.faces))
    methods = list(dict.fromkeys(method for face in gallery.faces for method in (*face.errors, *face.fits)))
    return {
        "kind": "gallery",
        "title": gallery.title,
        "note": gallery.note,
        "basis": "100%",
        "data": {
            "datasets": datasets,
            "methods": methods,
            "lines": [gallery.lines.get(dataset, ()) for dataset in datasets],
            "faces": [_gallery_face(face, datasets, methods) for face in gallery.faces],
        },
    }


def _gallery_face(face: GalleryFace, datasets: list[str], methods: list[str]) -> dict[str, Any]:
    return {
        "dataset": datasets.index(face.dataset),
        "name": face.face,
        "size": face.size,
        "jpeg": None if face.jpeg is None else base64.b64encode(face.jpeg).decode("ascii"),
        "truth": _tenths(face.truth),
        "fits": {methods.index(method): _tenths(points) for method, points in face.fits.items()},
        "errors": {methods.index(method): _json_number(error, 7) for method, error in face.errors.items()},
        "yaw": _json_number(face.yaw, 1),
        "pitch": _json_number(face.pitch, 1),
    }


def _tenths(points: np.ndarray) -> list[int | None]:
    """Points (L, 2) as x, y, x, y, ... in tenths of pixels; None where unknown."""
    return [round(10 * value) if math.isfinite(value) else None for value in points.astype(float).ravel().tolist()]


def _json_number(value: float, digits: int) -> float | str | None:
    """A number that JSON can hold: NaN is null, and infinity is spelt as JavaScript reads it."""
    if math.isnan(value):
        return None
    return round(float(value), digits) if math.isfinite(value) else "Infinity"
