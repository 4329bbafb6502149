"""What all trainings share: which faces can be learned from, their crops, and the faces in crop pixels."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jaxfit.cascade.greedy import Progress, TrainingSet
from jaxfit.data.boxes import box_centre
from jaxfit.data.crops import Crops, cut
from jaxfit.data.pictures import to_grey
from jaxfit.errors import ImageError
from jaxfit.image.frame import Frame
from jaxfit.labels.records import FaceRecord
from jaxfit.models.placements import Placement
from jaxfit.schemes.scheme import Scheme, mirrored

SILENT: Progress = lambda stage, done, total: None  # noqa: E731
# Width to length of a face below which it is a line.
_FLAT = 0.01


def usable_faces(faces: Sequence[FaceRecord], scheme: Scheme) -> tuple[list[FaceRecord], list[str]]:
    """The faces to learn from, and what is wrong with the others."""
    complete = [face for face in faces if face.complete]
    problems = []
    if left_out := len(faces) - len(complete):
        problems.append(f"{left_out} of {len(faces)} faces left out: not all {scheme.count} landmarks are annotated")
    flat = [_on_a_line(face.landmarks) for face in complete]
    problems += [
        f"{face.image}: all landmarks lie on a line" for face, of_face in zip(complete, flat, strict=True) if of_face
    ]
    return [face for face, of_face in zip(complete, flat, strict=True) if not of_face], problems


def _on_a_line(points: np.ndarray) -> bool:
    """Whether points (L, 2) lie on a line or in one point: they are no face, and tell no pose."""
    across, along = np.linalg.eigvalsh(np.cov(points.T))
    return bool(across <= _FLAT**2 * along)


def cut_labelled(
    faces: Sequence[FaceRecord],
    squares: np.ndarray,
    placement: Placement,
    frame: Frame,
    read: Callable[[Path], np.ndarray],
    progress: Progress,
    look: Callable[[int, np.ndarray], None] = lambda number, grey: None,
) -> tuple[Crops, np.ndarray, list[str]]:
    """The crops of faces in squares (N, 4), which of them could be read (M,), and why others could not.

    ``look`` is shown the number and the grey picture of each face.
    """
    crops = Crops.empty(len(faces), frame)
    rows, problems = [], []
    for number, face in enumerate(faces):
        progress("reading pictures", number, len(faces))
        try:
            grey = to_grey(read(face.image))
        except ImageError as error:
            problems.append(str(error))
            continue
        rows.append(number)
        cut(grey, *placement.face_in(squares[number]), crops, number)
        look(number, grey)
    progress("reading pictures", len(faces), len(faces))
    return crops, np.array(rows, int), problems


def training_set(
    crops: Crops, landmarks: np.ndarray, squares: np.ndarray, rows: np.ndarray, mirror: Scheme | None
) -> TrainingSet:
    """The faces in crop pixels; with ``mirror``, each a second time, flipped."""
    points = crops.from_images(landmarks[rows], rows)
    pivots = crops.from_images(np.stack([box_centre(square) for square in squares[rows]])[:, None], rows)[:, 0]
    flips = np.zeros(len(rows), bool)
    if mirror is not None:
        width = crops.pixels.shape[2]
        points, rows = np.concatenate([points, mirrored(points, width, mirror)]), np.concatenate([rows, rows])
        pivots = np.concatenate([pivots, [width - 1, 0] + pivots * [-1, 1]])
        flips = np.concatenate([flips, ~flips])
    return TrainingSet(crops.pixels, points.astype(np.float32), flips, rows, pivots.astype(np.float32))
