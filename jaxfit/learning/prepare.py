"""What all trainings share: which faces can be learned from, their crops, and the faces in crop pixels."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jaxfit.cascade.greedy import TrainingSet
from jaxfit.data.boxes import box_centre
from jaxfit.data.crops import Crops, cut
from jaxfit.data.pictures import Read, to_grey
from jaxfit.errors import ImageError
from jaxfit.image.frame import Frame
from jaxfit.labels.records import FaceRecord
from jaxfit.models.digests import picture_digest
from jaxfit.models.placements import Placement
from jaxfit.schemes.scheme import Scheme, mirrored
from jaxfit.types import Progress

# Width to length of a face below which it is a line, and above which faces usually are none.
_FLAT, _WIDE = 0.01, 0.1


def part_of(progress: Progress, part: str) -> Progress:
    """Progress within a part of some work, which is named before each of its stages."""
    return lambda stage, done, total: progress(f"{part}: {stage}", done, total)


def usable_faces(faces: Sequence[FaceRecord], scheme: Scheme) -> tuple[list[FaceRecord], list[str]]:
    """The faces to learn from, and what is wrong with the others."""
    complete = [face for face in faces if face.complete]
    problems = []
    if left_out := len(faces) - len(complete):
        problems.append(f"{left_out} of {len(faces)} faces left out: not all {scheme.count} landmarks are annotated")
    widths = np.array([_width(face.landmarks) for face in complete])
    # Landmarks of some schemes lie near a line on every face; where others do not, such labels are mistakes.
    narrow = _FLAT if len(widths) and np.median(widths) > _WIDE else 0.0
    usable = []
    for face, width in zip(complete, widths, strict=True):
        if np.ptp(face.landmarks, axis=0).max() == 0:
            problems.append(f"{face.image}: all landmarks lie in one point")
        elif width < narrow:
            problems.append(f"{face.image}: all landmarks lie on a line")
        else:
            usable.append(face)
    return usable, problems


def _width(points: np.ndarray) -> float:
    """Width to length of points (L, 2)."""
    across, along = np.linalg.eigvalsh(np.cov(points.T, bias=True))
    return float(np.sqrt(max(across, 0.0) / along)) if along > 0 else 0.0


def cut_labelled(
    faces: Sequence[FaceRecord],
    squares: np.ndarray,
    placement: Placement,
    frame: Frame,
    read: Read,
    progress: Progress,
    look: Callable[[int, np.ndarray], None] = lambda number, grey: None,
) -> tuple[Crops, np.ndarray, list[str], list[int]]:
    """The crops of faces in squares (N, 4), which of them could be read (M,), why others could not, and the digests of
    the pictures that could, one a picture.

    ``look`` is shown the number and the grey picture of each face.
    """
    crops = Crops.empty(len(faces), frame)
    rows, problems = [], []
    digests: dict[Path, int] = {}
    for number, face in enumerate(faces):
        progress("reading pictures", number, len(faces))
        try:
            grey = to_grey(read(face.image))
        except (ImageError, OSError) as error:
            problems.append(str(error))
            continue
        rows.append(number)
        if face.image not in digests:
            digests[face.image] = picture_digest(grey)
        cut(grey, *placement.face_in(squares[number]), crops, number)
        look(number, grey)
    progress("reading pictures", len(faces), len(faces))
    return crops, np.array(rows, int), problems, list(digests.values())


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
