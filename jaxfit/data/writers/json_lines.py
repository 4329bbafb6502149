"""Results as JSON lines: an object a face, with all that is known of it."""

import json
from pathlib import Path

from jaxfit.data.outputs import atomic_write
from jaxfit.data.rows import Rows, spelled


def write_json_lines(folder: Path, rows: Rows) -> list[str]:
    """``faces.jsonl``."""
    with atomic_write(folder / "faces.jsonl", "w") as file:
        for row in rows:
            file.write(json.dumps(spelled(row), ensure_ascii=False) + "\n")
    return ["faces.jsonl"]
