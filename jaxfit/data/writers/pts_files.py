"""Results as iBUG's ``.pts`` files, one a face."""

from pathlib import Path

import numpy as np

from jaxfit.data.outputs import not_written
from jaxfit.data.pts import write_pts
from jaxfit.data.rows import Rows
from jaxfit.errors import InputError

PTS = "pts"  # the folder that they are in


def write_pts_files(folder: Path, rows: Rows) -> list[str]:
    """``pts/FACE.pts``, counted from 1; a file that cannot be written is a failure of its picture."""
    write_pts_into(folder / PTS, rows)
    return [PTS]


def write_pts_into(folder: Path, rows: Rows) -> None:
    """``FACE.pts`` in a folder, made if needed."""
    folder.mkdir(exist_ok=True)
    for row in rows:
        path = folder / f"{row['face']}.pts"
        try:
            write_pts(path, np.array(row["landmarks"], np.float64))
        except (OSError, InputError) as error:
            rows.failures.append((row["image"], not_written(path, error)))
