"""One picture of many faces with their landmarks, to look over results at a glance."""

import heapq
from pathlib import Path
from unicodedata import combining, normalize

import cv2
import numpy as np

from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.overlays import draw_row
from jaxfit.data.pictures import read_image, write_image
from jaxfit.data.rows import Row, Rows
from jaxfit.errors import ImageError
from jaxfit.schemes.scheme import Scheme

MOST = 200
_ACROSS = 10
_SIDE = 220  # pixels of a face's square
_LETTERS = 18  # of a face's name that are shown, its last
_AROUND = 1.6  # sides of the square around the landmarks that are shown


def write_contact_sheet(path: Path, rows: Rows) -> list[tuple[str, str]]:
    """Write squares of up to 200 faces, those with the least confidence first, or the first where there is none.

    Args:
        path: of the picture to write.
        rows: the fitted faces, whose pictures are read again.

    Returns:
        Pictures that can no longer be read, and why; their squares are black.
    """
    shown = heapq.nsmallest(
        MOST,
        enumerate(rows),
        key=lambda entry: (entry[1].get("confidence", 1.0), entry[0]),
    )
    problems = []
    down = -(-max(1, len(shown)) // _ACROSS)
    sheet = np.zeros((down * _SIDE, min(_ACROSS, max(1, len(shown))) * _SIDE, 3), np.uint8)
    for place, (_, row) in enumerate(shown):
        try:
            square = _square(row, rows.scheme)
        except ImageError as error:
            problems.append((row["image"], str(error).removeprefix(f"{row['image']}: ")))
            continue
        top, left = _SIDE * (place // _ACROSS), _SIDE * (place % _ACROSS)
        sheet[top : top + _SIDE, left : left + _SIDE] = square
    write_image(path, sheet)
    return problems


def _square(row: Row, scheme: Scheme) -> np.ndarray:
    """A face (side, side, 3), its landmarks, and how sure it is."""
    landmarks = np.array(row["landmarks"])
    square = bounding_square(landmarks)
    scale = _SIDE / (_AROUND * max(square[2], 1.0))
    shift = (_SIDE - 1) / 2 - scale * box_centre(square)
    moved = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    cut = cv2.warpAffine(read_image(row["image"]), moved, (_SIDE, _SIDE), flags=cv2.INTER_AREA)
    placed = row | {"landmarks": (scale * landmarks + shift).tolist()}
    drawn = draw_row(
        cut, {name: value for name, value in placed.items() if name != "landmarks_3d"}, scheme, boxed=False
    )
    confidence = [f"{row['confidence']:.2f}"] if "confidence" in row else []
    _write(drawn, " ".join([_in_ascii(row["face"])[-_LETTERS:], *confidence]), row["ok"])
    return drawn


def _in_ascii(text: str) -> str:
    """Letters without their accents, and ``?`` for what has no such form: OpenCV's font has ASCII only."""
    letters = (letter for letter in normalize("NFKD", text) if not combining(letter))
    return "".join(letters).encode("ascii", "replace").decode()


def _write(square: np.ndarray, text: str, ok: bool) -> None:
    """Write below a face; its outline first, so that it can be read on any ground."""
    for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255) if ok else (255, 140, 0), 1)):
        cv2.putText(square, text, (4, _SIDE - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thickness, cv2.LINE_AA)
