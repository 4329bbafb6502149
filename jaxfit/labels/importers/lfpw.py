"""LFPW's tab-separated annotations: 29 points a face, each visible, obscured, self-occluded or out of the crop."""

import csv
import io
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxfit.data.inputs import read_text
from jaxfit.data.numbers import number
from jaxfit.errors import DatasetError
from jaxfit.labels.records import Dataset, FaceRecord, check_pictures
from jaxfit.schemes.known import LFPW29, LFPW29_NAMES

_COLUMNS = ("imgurl", "worker", *(f"{name}_{part}" for name in LFPW29_NAMES for part in "xyt"))
_MOST_BYTES = 1 << 26  # LFPW's file has three million
# 0 visible, 1 obscured, 2 self-occluded, 3 out of the crop: hidden points were placed by guess, but they were placed.
_STATES = ("0", "1", "2", "3")


@dataclass(frozen=True)
class _Row:
    where: str  # file and line, for messages
    line: int
    cells: dict[str, str]

    @property
    def name(self) -> str:
        """The picture's path relative to the file's folder, without suffix; empty if the row names no picture."""
        image = Path(self.cells["imgurl"] or "")  # a short row has None in its last cells
        return image.with_suffix("").as_posix() if image.name else ""


def read_lfpw(file: str | Path) -> Dataset:
    """The faces of an LFPW annotation file; ``imgurl`` is the picture's path relative to the file's folder.

    Columns are found by name, in any order. Of several workers' rows for a picture the one of the worker ``average``
    counts. Landmarks are pixels, taken as 0-based; ``visible`` is False where a point was obscured, self-occluded or
    out of the crop. Rows that cannot be used become problems.

    Raises:
        DatasetError: the file is missing, lacks columns, no row can be used, or no picture exists.
    """
    file = Path(file)
    chosen, problems = _choose(_rows(file))
    repeated = Counter(row.name for row in chosen)
    faces = []
    for row in chosen:
        try:
            faces.append(_record(row, file.parent, several=repeated[row.name] > 1))
        except DatasetError as error:
            problems.append(str(error))
    if not faces:
        reason = f"first problem: {problems[0]}" if problems else "it has no rows"
        raise DatasetError(f"{file}: expected one face a row; {reason}")
    check_pictures(file, faces)
    return Dataset(spec=f"lfpw:{file}", scheme=LFPW29, faces=tuple(faces), problems=tuple(problems))


def _rows(file: Path) -> list[_Row]:
    try:
        reader = csv.DictReader(io.StringIO(read_text(file, _MOST_BYTES), newline=""), delimiter="\t")
        missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            reason = ", ".join(missing[:3]) + (", …" if len(missing) > 3 else "")
            raise DatasetError(f"{file}: expected LFPW's tab-separated columns; {len(missing)} missing: {reason}")
        return [_Row(f"{file}, line {reader.line_num}", reader.line_num, cells) for cells in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{file}: expected LFPW's tab-separated annotation file; {error}") from error


def _choose(rows: list[_Row]) -> tuple[list[_Row], list[str]]:
    """Rows to use, in the file's order: the averages, and rows that are their picture's only one or name none."""
    total = Counter(row.cells["imgurl"] for row in rows)
    averaged = {row.cells["imgurl"] for row in rows if row.cells["worker"] == "average"}
    chosen, problems = [], []
    for row in rows:
        image = row.cells["imgurl"]
        if row.cells["worker"] == "average" or total[image] == 1 or not row.name:
            chosen.append(row)
        elif image not in averaged:
            problems.append(f"{row.where}: {image} has several workers but no row of the worker 'average'")
    return chosen, problems


def _record(row: _Row, folder: Path, several: bool) -> FaceRecord:
    if not row.name:
        raise DatasetError(f"{row.where}: the row names no picture")
    try:
        x, y = (np.array([number(row.cells[f"{name}_{axis}"]) for name in LFPW29_NAMES]) for axis in "xy")
        states = [_STATES.index(row.cells[f"{name}_t"].strip()) for name in LFPW29_NAMES]
    # AttributeError and TypeError: a short row has None in its last cells.
    except (ValueError, TypeError, AttributeError):
        raise DatasetError(f"{row.where}: expected numbers x, y and a state 0 to 3 for each of 29 points") from None
    landmarks = np.stack([x, y], axis=1)
    if not np.isfinite(landmarks).all():
        raise DatasetError(f"{row.where}: expected finite coordinates")
    return FaceRecord(
        image=folder / row.cells["imgurl"],
        landmarks=landmarks,
        present=np.ones(len(landmarks), bool),
        visible=np.array(states) == 0,
        box=None,
        pose=None,
        subject=row.name,
        face=f"{row.name}-{row.line}" if several else row.name,
    )
