"""JSON lines: an object a face, as ``jaxfit fit --format jsonl`` writes them."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.errors import DatasetError
from jaxfit.labels.importers.annotations import Annotation, annotation_text
from jaxfit.schemes.known import NO_LANDMARKS, scheme_named
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import ANGLES

_KIND = "JSON lines, an object a face with image, and landmarks or pose"
_BOX = ("x", "y", "width", "height")


def json_lines_annotations(file: Path) -> tuple[Scheme, list[Annotation], list[str]]:
    """What the landmarks of a file of JSON lines mean, its faces, and the problems of those that cannot be used.

    Of each face: ``image``, a path; ``landmarks``, a list of [x, y], null where missing; and, where it is known,
    ``face``, ``box`` (an object of x, y, width and height) and ``pose`` (one of roll, pitch and yaw, in degrees).

    Raises:
        DatasetError: the file cannot be read.
    """
    found: list[Annotation] = []
    problems: list[str] = []
    for number, line in enumerate(annotation_text(file, _KIND).splitlines(), 1):
        if line.strip():
            where = f"{file}, line {number}"
            try:
                found.append(_annotation(json.loads(line), where))
            except (DatasetError, ValueError, TypeError, RecursionError) as error:
                problems.append(f"{where}: expected an object of a face; {error}")
    count = max((len(each.landmarks) for each in found), default=0)
    return scheme_named(f"points{count}") if count else NO_LANDMARKS, found, problems


def _annotation(face: Any, where: str) -> Annotation:
    if not isinstance(face, dict) or not isinstance(face.get("image"), str) or not face["image"]:
        raise DatasetError("got none with the path of its picture as image")
    points = [[None, None] if point is None else point for point in face.get("landmarks") or []]
    landmarks = np.array(points, np.float64).reshape(-1, 2)
    box, pose = (
        np.array([of.get(name) for name in names], np.float64) if isinstance(of := face.get(key), dict) else None
        for key, names in (("box", _BOX), ("pose", ANGLES))
    )
    return Annotation(
        where,
        face["image"],
        landmarks,
        face=str(face.get("face", "")),
        box=box if box is not None and np.isfinite(box).all() else None,
        pose=pose if pose is not None and np.isfinite(pose).any() else None,
    )
