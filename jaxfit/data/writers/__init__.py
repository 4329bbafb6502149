"""Formats of results, by the names that the command line knows."""

from jaxfit.data.writers.annotations import write_imglab_results, write_tps_results
from jaxfit.data.writers.coco import write_coco
from jaxfit.data.writers.csv_tables import write_tables
from jaxfit.data.writers.json_lines import write_json_lines
from jaxfit.data.writers.parquet import require_pyarrow, write_parquet
from jaxfit.data.writers.pts_files import PTS, write_pts_files
from jaxfit.data.writers.writer import Writer

__all__ = ["DEFAULT_FORMATS", "PTS", "WRITERS", "Writer", "require_pyarrow"]

WRITERS: dict[str, Writer] = {
    "csv": write_tables,
    "pts": write_pts_files,
    "parquet": write_parquet,
    "jsonl": write_json_lines,
    "coco": write_coco,
    "tps": write_tps_results,
    "imglab": write_imglab_results,
}
DEFAULT_FORMATS = ("csv", "pts")
