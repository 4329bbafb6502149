"""Results as Parquet, for pandas, Polars, DuckDB and the like; needs ``jaxfit[parquet]``."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from jaxfit.data.outputs import atomic_path
from jaxfit.data.writers.tables import TEXTS, Table, tables_of
from jaxfit.data.writers.writer import Results
from jaxfit.exceptions import InputError

_ROWS = 4096  # that are in memory at a time


def write_parquet(folder: Path, results: Results) -> list[str]:
    """``landmarks.parquet``, and for 3D models ``heads.parquet``: the columns of the CSV files, as float32.

    Raises:
        InputError: pyarrow is not installed.
    """
    require_pyarrow()
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = []
    for table in tables_of(results):
        names.append(f"{table.name}.parquet")
        types = [(name, pa.string() if name in TEXTS else pa.float32()) for name in table.columns]
        schema = pa.schema(types)
        with atomic_path(folder / names[-1]) as path, pq.ParquetWriter(path, schema) as writer:
            for columns in _columns(table, results):
                arrays = [_array(column, type_) for column, (_, type_) in zip(columns, types, strict=True)]
                writer.write_batch(pa.record_batch(arrays, schema=schema))
    return names


def require_pyarrow() -> None:
    """Check that Parquet can be written.

    Raises:
        InputError: pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise InputError('Parquet needs pyarrow, which is not installed: pip install "jaxfit[parquet]"') from None


def _array(values: tuple[str | float | None, ...], type_: Any) -> Any:
    """A column; what is not UTF-8 in names of files becomes question marks."""
    import pyarrow as pa

    plain = [value.encode("utf-8", "replace").decode() if isinstance(value, str) else value for value in values]
    return pa.array(plain, type_)


def _columns(table: Table, results: Results) -> Iterator[list[tuple[str | float | None, ...]]]:
    """The table's columns, some rows at a time."""
    rows = map(table.row, results.faces())
    while some := list(islice(rows, _ROWS)):
        yield list(zip(*some, strict=True))
