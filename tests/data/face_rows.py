"""Rows of faces as models with and without 3D and a confidence give them, for what writes or flattens rows."""

from collections.abc import Sequence

import numpy as np

from jaxfit.data.rows import Row, Rows, rounded
from jaxfit.schemes.known import IBUG68
from jaxfit.schemes.openness import openings_of
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import ANGLES

RNG = np.random.default_rng(0)


def face_row(image: str, face: str, scheme: Scheme = IBUG68, modes: int | None = None, confidence: float = -1) -> Row:
    """A row with random numbers; in 3D if it has modes, and with a confidence if that is none below 0."""

    def numbers(*shape: int) -> list:
        return rounded(RNG.uniform(-20, 200, shape))

    row: Row = {
        "image": image,
        "face": face,
        "size": {"width": 320, "height": 200},
        "box": dict(zip(("x", "y", "width", "height", "rotation"), numbers(5), strict=True)) | {"kind": "haar-frontal"},
        "ok": confidence > 0.2,
        "landmarks": numbers(scheme.count, 2),
    }
    if openings := openings_of(scheme):
        row["openness"] = dict(zip((opening.name for opening in openings), numbers(len(openings)), strict=True))
    if confidence >= 0:
        row["confidence"] = confidence
    if modes is not None:
        row["pose"] = dict(zip(ANGLES, numbers(3), strict=True))
        row |= {"scale": 1.5, "landmarks_3d": numbers(scheme.count, 3), "b": numbers(modes)}
    return row


def rows_of(faces: Sequence[Row], scheme: Scheme = IBUG68) -> Rows:
    """The rows of one model."""
    first = faces[0] if faces else {}
    return Rows(scheme, len(first["b"]) if "b" in first else None, "confidence" in first, lambda: iter(faces))


PLAIN = [face_row("a/ä, b.jpg", "ä, b_1"), face_row("a/ä, b.jpg", "ä, b_2"), face_row("c.jpg", "c_1")]
SURE = [face_row(f"{n}.jpg", f"{n}_1", modes=4, confidence=0.25 * n) for n in range(3)]
