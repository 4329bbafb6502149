"""Results as iBUG's ``.pts`` files, one a face."""

from pathlib import Path

import numpy as np

from jaxfit.data.pts import write_pts
from jaxfit.data.writers.writer import Results


def write_pts_files(folder: Path, results: Results) -> list[str]:
    """``pts/FACE.pts``, counted from 1."""
    (folder / "pts").mkdir(exist_ok=True)
    for face in results.faces():
        write_pts(folder / "pts" / f"{face.face}.pts", np.reshape(face.landmarks, (-1, 2)))
    return ["pts"]
