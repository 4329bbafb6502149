"""Results as JSON lines: an object a face, with all that is known of it."""

import json
from pathlib import Path
from typing import Any

from jaxfit.data.fitted import FittedFace, Numbers
from jaxfit.data.outputs import atomic_write
from jaxfit.data.writers.writer import Results
from jaxfit.evaluation.pose import ANGLES


def write_json_lines(folder: Path, results: Results) -> list[str]:
    """``faces.jsonl``."""
    with atomic_write(folder / "faces.jsonl", "w") as file:
        for face in results.faces():
            file.write(json.dumps(_object(face), ensure_ascii=False) + "\n")
    return ["faces.jsonl"]


def _object(face: FittedFace) -> dict[str, Any]:
    told: dict[str, Any] = {
        "image": face.image,
        "face": face.face,
        "size": dict(zip(("width", "height"), face.size, strict=True)),
        "box": {"kind": face.kind, **dict(zip(("x", "y", "width", "height"), face.box, strict=True))},
        "landmarks": _points(face.landmarks, 2),
    }
    if face.confidence is not None:
        told["confidence"] = face.confidence
    if face.pose is not None and face.landmarks_3d is not None and face.b is not None:
        told["pose"] = dict(zip(ANGLES, face.pose, strict=True))
        told |= {"scale": face.scale, "landmarks_3d": _points(face.landmarks_3d, 3), "b": face.b}
    return told


def _points(numbers: Numbers, axes: int) -> list[Numbers]:
    return [numbers[first : first + axes] for first in range(0, len(numbers), axes)]
