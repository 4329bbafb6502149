"""Results as COCO keypoints, which labelling programs and training code read."""

import json
from collections.abc import Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

from jaxfit.data.names import table_path
from jaxfit.data.outputs import atomic_write
from jaxfit.data.rows import Row, Rows
from jaxfit.schemes.scheme import Scheme


def write_coco(folder: Path, rows: Rows) -> list[str]:
    """``keypoints.json``: the pictures with faces, and an annotation a face; scores are confidences, 1 if unknown.

    As in COCO, keypoints count pixels from 0 at the centre of the first, and boxes from its corner.
    """
    lists = {
        "images": _images(rows),
        "annotations": _annotations(rows),
        "categories": iter([_category(rows.scheme)]),
    }
    with atomic_write(folder / "keypoints.json", "w") as file:
        # Written by hand: as one object, the results of a million pictures would not fit in memory.
        for number, (name, objects) in enumerate(lists.items()):
            file.write(("{" if number == 0 else ",\n") + json.dumps(name) + ": [")
            for place, entry in enumerate(objects):
                file.write((",\n" if place else "\n") + json.dumps(entry))
            file.write("]")
        file.write("}\n")
    return ["keypoints.json"]


def _numbered(rows: Rows) -> Iterator[tuple[int, bool, Row]]:
    """The faces with the number of their picture, from 1, and whether they are its first."""
    number, before = 0, None
    for row in rows:
        first = row["image"] != before
        number, before = number + first, row["image"]
        yield number, first, row


def _images(rows: Rows) -> Iterator[dict[str, Any]]:
    for number, first, row in _numbered(rows):
        if first:
            yield {"id": number, "file_name": table_path(row["image"]), **row["size"]}


def _annotations(rows: Rows) -> Iterator[dict[str, Any]]:
    for face_number, (number, _, row) in enumerate(_numbered(rows), 1):
        across, down = zip(*row["landmarks"], strict=True)
        width, height = (max(values) - min(values) for values in (across, down))
        yield {
            "id": face_number,
            "image_id": number,
            "category_id": 1,
            "keypoints": list(chain.from_iterable((x, y, 2) for x, y in row["landmarks"])),
            "num_keypoints": len(across),
            "bbox": [round(value, 3) for value in (min(across) + 0.5, min(down) + 0.5, width, height)],
            "area": round(width * height, 3),
            "iscrowd": 0,
            "score": row.get("confidence", 1.0),
        }


def _category(scheme: Scheme) -> dict[str, Any]:
    return {
        "id": 1,
        "name": "face",
        "supercategory": "person",
        "keypoints": [f"{scheme.name}_{number}" for number in range(1, scheme.count + 1)],
        "skeleton": [[start + 1, end + 1] for line in scheme.lines for start, end in pairwise(line)],
    }
