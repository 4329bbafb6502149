"""One picture of many faces with their landmarks, to look over results at a glance."""

import heapq
from pathlib import Path

import cv2
import numpy as np

from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.overlays import draw_landmarks
from jaxfit.data.pictures import read_image, write_image
from jaxfit.data.rows import Row, Rows
from jaxfit.errors import ImageError
from jaxfit.schemes.scheme import Scheme

MOST = 200
_ACROSS = 20
_SIDE = 120  # pixels of a face's square
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
    drawn = draw_landmarks(cut, scale * landmarks + shift, scheme)
    if "confidence" in row:
        place = (3, _SIDE - 5)
        for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            text = f"{row['confidence']:.2f}"
            cv2.putText(drawn, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, thickness, cv2.LINE_AA)
    return drawn
