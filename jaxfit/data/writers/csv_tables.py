"""Results as comma-separated values."""

from pathlib import Path

from jaxfit.data.outputs import write_csv
from jaxfit.data.rows import Rows, table_text, table_values


def write_tables(folder: Path, rows: Rows) -> list[str]:
    """``landmarks.csv``, and for 3D models ``heads.csv``."""
    names = []
    for name, columns in rows.tables().items():
        names.append(f"{name}.csv")
        write_csv(
            folder / names[-1], columns, ([table_text(value) for value in table_values(name, row)] for row in rows)
        )
    return names
