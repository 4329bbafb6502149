"""The seam for writers of results: rows in, files out."""

from pathlib import Path
from typing import Protocol

from jaxfit.data.rows import Rows


class Writer(Protocol):
    """Writes results in one format. One row at a time is in memory; files are written whole or not at all.

    What cannot be written of one picture is added to the rows' ``failures``, and does not stop the others.
    """

    def __call__(self, folder: Path, rows: Rows) -> list[str]:
        """Write into a folder.

        Returns:
            The names of what was written there.
        """
        ...
