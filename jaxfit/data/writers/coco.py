"""Results as COCO keypoints, which labelling programs and training code read."""

import json
from collections.abc import Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

from jaxfit.data.names import table_path, table_word
from jaxfit.data.outputs import atomic_write
from jaxfit.data.rows import PIXEL, Row, Rows
from jaxfit.schemes.known import SCHEMES
from jaxfit.schemes.scheme import Scheme


def write_coco(folder: Path, rows: Rows) -> list[str]:
    """``keypoints.json``: the pictures with faces, and an annotation a face; scores are confidences, 1 if unknown.

    As in COCO, keypoints count pixels from 0 at the centre of the first, and boxes from its corner.
    """
    write_keypoints(folder / "keypoints.json", rows)
    return ["keypoints.json"]


def write_keypoints(path: Path, rows: Rows) -> None:
    """A COCO file of faces or other objects: keypoints of missing points have v = 0, of hidden ones 1."""
    lists = {
        "images": _images(rows),
        "annotations": _annotations(rows),
        "categories": iter([_category(rows.scheme)]),
    }
    with atomic_write(path, "w") as file:
        # Written by hand: as one object, the results of a million pictures would not fit in memory.
        for number, (name, objects) in enumerate(lists.items()):
            file.write(("{" if number == 0 else ",\n") + json.dumps(name) + ": [")
            for place, entry in enumerate(objects):
                file.write((",\n" if place else "\n") + json.dumps(entry))
            file.write("]")
        file.write("}\n")


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
            yield {"id": number, "file_name": table_path(row["image"]), **row.get("size", {})}


def _annotations(rows: Rows) -> Iterator[dict[str, Any]]:
    for face_number, (number, _, row) in enumerate(_numbered(rows), 1):
        known = [(x, y) for x, y in row["landmarks"] if x is not None]
        hidden = _hidden(row)
        left, top, width, height = _box(row, known)
        yield {
            "id": face_number,
            "image_id": number,
            "category_id": 1,
            "keypoints": list(
                chain.from_iterable(
                    (0, 0, 0) if x is None else (x, y, 1 if state else 2)
                    for (x, y), state in zip(row["landmarks"], hidden, strict=True)
                )
            ),
            "num_keypoints": len(known),
            "bbox": [round(value, 3) for value in (left + 0.5, top + 0.5, width, height)],
            "area": round(width * height, 3),
            "iscrowd": 0,
            "score": row.get("confidence", 1.0),
            **_of_labels(row),
        }


def _hidden(row: Row) -> list[bool]:
    """Which points are hidden: as labelled, or rather than not, as a model says; none where nothing is known."""
    if "visible" in row:
        return [probability < 0.5 for probability in row["visible"]]
    return row.get("hidden") or [False] * len(row["landmarks"])


def _box(row: Row, known: list[tuple[float, float]]) -> tuple[float, float, float, float]:
    """The labelled box; without one, as fits are, whose box is what a detector drew, that around the points."""
    if "kind" not in row.get("box", {"kind": ""}):
        box = row["box"]
        return box["x"], box["y"], box["width"], box["height"]
    across, down = zip(*known, strict=True)
    return min(across), min(down), max(across) - min(across), max(down) - min(down)


def _of_labels(row: Row) -> dict[str, Any]:
    """What COCO has no keys for."""
    names = {key: table_word(row[key]) for key in ("face", "subject") if row.get(key)}
    return names | ({"scale": row[PIXEL]} if row.get(PIXEL) else {})


def _category(scheme: Scheme) -> dict[str, Any]:
    known = scheme.name in SCHEMES
    return {
        "id": 1,
        "name": "face" if known else scheme.name,
        "supercategory": "person" if known else "object",
        "keypoints": list(scheme.names) or [f"{scheme.name}_{number}" for number in range(1, scheme.count + 1)],
        "skeleton": [[start + 1, end + 1] for line in scheme.lines for start, end in pairwise(line)],
    }
