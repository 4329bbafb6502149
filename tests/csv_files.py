"""Tables that the tests read, and face boxes that they write."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxfit.data.boxes import bounding_square
from jaxfit.data.pts import read_pts


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows of a table, by column."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write_boxes(path: Path, boxes: Mapping[str, Sequence[float] | np.ndarray]) -> Path:
    """A file of face boxes: for each name of a picture, x, y, width and height."""
    lines = [f"{name},{','.join(map(str, box))}" for name, box in boxes.items()]
    path.write_text("\n".join(["image,x,y,width,height", *lines]) + "\n")
    return path


def labelled_box(picture: Path) -> np.ndarray:
    """The square (4,) around the landmarks that lie in a ``.pts`` file beside a picture."""
    return bounding_square(read_pts(picture.with_suffix(".pts")))
