"""Files of annotations, as programs for labelling read them: one file, or for ``.pts`` a folder, of all rows.

Rows are those of fits, or of labels (`jaxfit.data.rows.Row`).
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from xml.sax.saxutils import quoteattr

from jaxfit.data.names import table_path, table_word
from jaxfit.data.outputs import atomic_write, write_csv
from jaxfit.data.rows import PIXEL, Row, Rows
from jaxfit.data.writers.coco import write_keypoints
from jaxfit.data.writers.pts_files import write_pts_into

_SIDES = ("x", "y", "width", "height")


@dataclass(frozen=True)
class AnnotationFormat:
    """A format that labels can be written in.

    Attributes:
        write: writes the rows to a file, or into a folder, that need not exist.
        keeps: which of ``box``, ``hidden``, ``scale`` and ``subject`` it can hold.
        suffix: what names of such files end in; empty for folders.
    """

    write: Callable[[Path, Rows], None]
    keeps: frozenset[str]
    suffix: str


def write_tps(path: Path, rows: Rows) -> None:
    """A TPS file: y counts from the bottom of the picture, missing points are ``NA``, ``IMAGE`` is the picture's path
    from the file's folder. Pictures of unknown height are failures."""
    with atomic_write(path, "w") as file:
        for row in _of_known_size(rows, "TPS files"):
            height = row["size"]["height"]
            file.write(f"LM={rows.scheme.count}\n")
            file.writelines("NA NA\n" if x is None else f"{x:.3f} {height - y:.3f}\n" for x, y in row["landmarks"])
            file.write(f"IMAGE={table_path(row['image'])}\n")
            if face := row.get("face"):
                file.write(f"ID={table_word(face)}\n")
            if scale := row.get(PIXEL):
                file.write(f"SCALE={scale:.9g}\n")


def write_imglab(path: Path, rows: Rows) -> None:
    """An XML file of imglab: boxes of whole pixels, and parts, which are whole pixels, too, as dlib reads no others;
    missing points are no parts. Objects without a box get the one around their points."""
    digits = len(str(max(0, rows.scheme.count - 1)))
    names = [quoteattr(name) for name in rows.scheme.names or (f"{n:0{digits}d}" for n in range(rows.scheme.count))]
    with atomic_write(path, "w") as file:
        file.write("<?xml version='1.0' encoding='UTF-8'?>\n<dataset>\n<name>landmarks</name>\n<images>\n")
        before = None
        for row in rows:
            if row["image"] != before:
                file.write("" if before is None else "  </image>\n")
                size = (
                    "".join(f" {side}='{row['size'][side]}'" for side in ("width", "height")) if "size" in row else ""
                )
                file.write(f"  <image file={quoteattr(table_path(row['image']))}{size}>\n")
                before = row["image"]
            left, top, width, height = _box_of(row)
            file.write(f"    <box top='{top}' left='{left}' width='{width}' height='{height}'>\n")
            file.writelines(
                f"      <part name={name} x='{round(x)}' y='{round(y)}'/>\n"
                for name, (x, y) in zip(names, row["landmarks"], strict=True)
                if x is not None
            )
            file.write("    </box>\n")
        file.write("" if before is None else "  </image>\n")
        file.write("</images>\n</dataset>\n")


def write_wide(path: Path, rows: Rows) -> None:
    """A CSV table with a row an object: ``image``, ``face``, ``subject``, a box, ``scale``, and two columns a point,
    or three, of which the third is 1 of hidden ones."""
    scheme = rows.scheme
    names = [scheme.point_name(index) for index in range(scheme.count)]
    hidden = any(any(row.get("hidden", ())) for row in rows)
    axes = "xyv" if hidden else "xy"
    of_point = [[f"{name}_{axis}" if scheme.names else f"{axis}{name}" for axis in axes] for name in names]
    optional = [key for key in ("subject", PIXEL) if any(row.get(key) for row in rows)]
    header = ["image", "face", *_SIDES, *("scale" if key == PIXEL else key for key in optional)]

    def cells(row: Row) -> Iterator[str]:
        yield table_path(row["image"])
        yield table_word(row.get("face", ""))
        box = row.get("box", {})
        yield from (f"{box[side]:.3f}" if side in box else "" for side in _SIDES)
        for key in optional:
            value = row.get(key)
            yield "" if not value else table_word(value) if key == "subject" else f"{value:.9g}"
        states = row.get("hidden") or [False] * scheme.count
        for (x, y), state in zip(row["landmarks"], states, strict=True):
            yield from ("", "") if x is None else (f"{x:.3f}", f"{y:.3f}")
            if hidden:
                yield str(int(state))

    write_csv(path, [*header, *chain.from_iterable(of_point)], (list(cells(row)) for row in rows))


def write_ml_morph(path: Path, rows: Rows) -> None:
    """A CSV table as ml-morph reads it: the picture's name, then x and y, which counts from the picture's bottom;
    missing points are ``NA``. Pictures of unknown height are failures."""
    header = ["id", *(f"{axis}{number}" for number in range(1, rows.scheme.count + 1) for axis in "XY")]

    def cells(row: Row) -> Iterator[str]:
        yield table_path(row["image"])
        for x, y in row["landmarks"]:
            yield from ("NA", "NA") if x is None else (f"{x:.3f}", f"{row['size']['height'] - y:.3f}")

    write_csv(path, header, (list(cells(row)) for row in _of_known_size(rows, "ml-morph's tables")))


def _of_known_size(rows: Rows, what: str) -> Iterator[Row]:
    """The rows of pictures whose height is known; others are failures."""
    for row in rows:
        if "size" in row:
            yield row
        else:
            rows.failures.append((row["image"], f"left out of {what}, whose y counts from the bottom: no such picture"))


def relative_to(folder: Path, rows: Rows) -> Rows:
    """The rows, whose pictures are called by their paths from a folder, always with ``/``: programs that label look for
    pictures from the file's folder."""

    def named(row: Row) -> Row:
        try:
            path = os.path.relpath(row["image"], folder)
        except ValueError:  # on another drive of Windows
            path = os.path.abspath(row["image"])
        return row | {"image": Path(path).as_posix()}

    return replace(rows, begin=lambda: map(named, rows.begin()))


def write_tps_results(folder: Path, rows: Rows) -> list[str]:
    """``landmarks.tps``."""
    write_tps(folder / "landmarks.tps", relative_to(folder, rows))
    return ["landmarks.tps"]


def write_imglab_results(folder: Path, rows: Rows) -> list[str]:
    """``landmarks.xml``."""
    write_imglab(folder / "landmarks.xml", relative_to(folder, rows))
    return ["landmarks.xml"]


def _box_of(row: Row) -> list[int]:
    """Left, top, width and height in whole pixels."""
    if "box" in row:
        return [round(row["box"][side]) for side in _SIDES]
    across, down = zip(*((x, y) for x, y in row["landmarks"] if x is not None), strict=True)
    left, top = round(min(across)), round(min(down))
    return [left, top, round(max(across)) - left + 1, round(max(down)) - top + 1]


ANNOTATION_FORMATS = {
    "tps": AnnotationFormat(write_tps, frozenset({"scale"}), ".tps"),
    "imglab": AnnotationFormat(write_imglab, frozenset({"box"}), ".xml"),
    "coco": AnnotationFormat(write_keypoints, frozenset({"box", "hidden", "scale", "subject"}), ".json"),
    "csv": AnnotationFormat(write_wide, frozenset({"box", "hidden", "scale", "subject"}), ".csv"),
    "ml-morph": AnnotationFormat(write_ml_morph, frozenset(), ".csv"),
    "pts": AnnotationFormat(write_pts_into, frozenset(), ""),
}
