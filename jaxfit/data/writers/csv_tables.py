"""Results as comma-separated values."""

from pathlib import Path

from jaxfit.data.outputs import write_csv
from jaxfit.data.writers.tables import tables_of
from jaxfit.data.writers.writer import Results


def write_tables(folder: Path, results: Results) -> list[str]:
    """``landmarks.csv``, and for 3D models ``heads.csv``."""
    names = []
    for table in tables_of(results):
        names.append(f"{table.name}.csv")
        rows = ([_text(value) for value in table.row(face)] for face in results.faces())
        write_csv(folder / names[-1], table.columns, rows)
    return names


def _text(value: str | float | None) -> str:
    return "" if value is None else value if isinstance(value, str) else f"{value:.3f}"
