"""Results as Parquet, for pandas, Polars, DuckDB and the like; needs ``jaxfit[parquet]``."""

from itertools import islice
from pathlib import Path

from jaxfit.data.outputs import atomic_path
from jaxfit.data.rows import FLAGS, TEXTS, Rows, table_values
from jaxfit.errors import InputError

_ROWS = 4096  # that are in memory at a time


def write_parquet(folder: Path, rows: Rows) -> list[str]:
    """``landmarks.parquet``, and for 3D models ``heads.parquet``: the columns of the CSV files, as float32.

    Raises:
        InputError: pyarrow is not installed.
    """
    require_pyarrow()
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = []
    for name, columns in rows.tables().items():
        names.append(f"{name}.parquet")
        of_column = dict.fromkeys(TEXTS, pa.string()) | dict.fromkeys(FLAGS, pa.bool_())
        types = [(column, of_column.get(column, pa.float32())) for column in columns]
        schema = pa.schema(types)
        with atomic_path(folder / names[-1]) as path, pq.ParquetWriter(path, schema) as writer:
            values = (table_values(name, row) for row in rows)
            while some := list(islice(values, _ROWS)):
                by_column = zip(zip(*some, strict=True), types, strict=True)
                arrays = [pa.array(column, type_) for column, (_, type_) in by_column]
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
