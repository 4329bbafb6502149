"""Results as COCO keypoints, which labelling programs and training code read."""

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

from jaxfit.data.fitted import FittedFace
from jaxfit.data.outputs import atomic_write
from jaxfit.data.writers.writer import Results
from jaxfit.shapes.schemes import Scheme


def write_coco(folder: Path, results: Results) -> list[str]:
    """``keypoints.json``: the pictures with faces, and an annotation a face; scores are confidences, 1 if unknown.

    As in COCO, keypoints count pixels from 0 at the centre of the first, and boxes from its corner.
    """
    lists = {
        "images": _images(results),
        "annotations": _annotations(results),
        "categories": iter([_category(results.scheme)]),
    }
    with atomic_write(folder / "keypoints.json", "w") as file:
        # Written by hand: as one object, the results of a million pictures would not fit in memory.
        for number, (name, objects) in enumerate(lists.items()):
            file.write(("{" if number == 0 else ",\n") + json.dumps(name) + ": [")
            for place, told in enumerate(objects):
                file.write((",\n" if place else "\n") + json.dumps(told))
            file.write("]")
        file.write("}\n")
    return ["keypoints.json"]


def _numbered(results: Results) -> Iterator[tuple[int, bool, FittedFace]]:
    """The faces with the number of their picture, from 1, and whether they are its first."""
    number, before = 0, None
    for face in results.faces():
        first = face.image != before
        number, before = number + first, face.image
        yield number, first, face


def _images(results: Results) -> Iterator[dict[str, Any]]:
    for number, first, face in _numbered(results):
        if first:
            width, height = face.size
            yield {"id": number, "file_name": face.image, "width": width, "height": height}


def _annotations(results: Results) -> Iterator[dict[str, Any]]:
    for face_number, (number, _, face) in enumerate(_numbered(results), 1):
        across, down = face.landmarks[0::2], face.landmarks[1::2]
        width, height = (max(values) - min(values) for values in (across, down))
        yield {
            "id": face_number,
            "image_id": number,
            "category_id": 1,
            "keypoints": [value for x, y in zip(across, down, strict=True) for value in (x, y, 2)],
            "num_keypoints": len(across),
            "bbox": [round(value, 3) for value in (min(across) + 0.5, min(down) + 0.5, width, height)],
            "area": round(width * height, 3),
            "iscrowd": 0,
            "score": 1.0 if face.confidence is None else face.confidence,
        }


def _category(scheme: Scheme) -> dict[str, Any]:
    return {
        "id": 1,
        "name": "face",
        "supercategory": "person",
        "keypoints": [f"{scheme.name}_{number}" for number in range(1, scheme.count + 1)],
        "skeleton": [[start + 1, end + 1] for line in scheme.lines for start, end in pairwise(line)],
    }
