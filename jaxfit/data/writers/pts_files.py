"""Results as iBUG's ``.pts`` files, one a face."""

from pathlib import Path

import numpy as np

from jaxfit.data.pts import write_pts
from jaxfit.data.rows import Rows


def write_pts_files(folder: Path, rows: Rows) -> list[str]:
    """``pts/FACE.pts``, counted from 1."""
    (folder / "pts").mkdir(exist_ok=True)
    for row in rows:
        write_pts(folder / "pts" / f"{row['face']}.pts", np.array(row["landmarks"]))
    return ["pts"]
