"""Fitting pictures with exported models, as those do who have only their file."""

import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from jaxfit.data.boxes import box_array, box_problem, rotation_array
from jaxfit.data.crops import Crop, Crops, cut_face
from jaxfit.data.pictures import read_grey
from jaxfit.errors import ImageError
from jaxfit.fitting.export import Exported
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.fitting.sources import NO_BOX
from jaxfit.fitting.stream import in_pictures


def fit_exported(
    exported: Exported,
    images: Sequence[Path],
    boxes: np.ndarray,
    kind: str | Sequence[str],
    rotations: np.ndarray | None = None,
) -> Fits:
    """The fits of faces in boxes by an exported model, a row for each, as ``jaxfit.fit`` gives them.

    Args:
        exported: the model.
        images: N files of pictures.
        boxes: (N, 4) x, y, width, height in pixels; NaN where there is none.
        kind: what drew the boxes, of those that the model knows: one for all, or N.
        rotations: (N,) how far the faces are turned, in degrees, clockwise as seen; None: not at all.

    Raises:
        InputError: boxes or rotations of another number.
    """
    count = len(images)
    boxes, turned = box_array(boxes, count), rotation_array(rotations, count)
    kinds = [kind] * count if isinstance(kind, str) else list(kind)
    faces: list[Crop | str] = []
    sizes = np.zeros((count, 2), int)
    for image, rows in groupby(range(count), images.__getitem__):
        grey: np.ndarray | str
        try:
            grey = read_grey(image)
        except (ImageError, OSError) as error:
            grey = str(error).removeprefix(f"{image}: ")
        for row in rows:
            if isinstance(grey, str):
                faces.append(grey)
                continue
            sizes[row] = grey.shape[::-1]
            faces.append(_cut(exported, grey, boxes[row], kinds[row], math.radians(turned[row])))
    crops = Crops.of(faces, exported.frame)
    uncut = np.array([isinstance(face, str) for face in faces], bool)
    found = in_pictures(crops, exported(crops.pixels))
    for values in found.values():
        values[uncut] = np.nan
    names = ("landmarks_3d", "pose", "scale", "b", "confidence", "covariances", "visible")
    lost = ~np.isfinite(found["landmarks"]).all((1, 2))
    reasons = [face if isinstance(face, str) else "the fit diverged" for face in faces]
    return Fits(
        scheme=exported.scheme,
        names=tuple(map(str, images)),
        sizes=sizes,
        pictures=np.arange(count),
        boxes=boxes,
        kinds=tuple(kinds),
        rotations=turned,
        landmarks=found["landmarks"],
        problems=tuple(
            Problem(row, str(images[row]), reasons[row], row) for row in np.flatnonzero(uncut | lost).tolist()
        ),
        **{name: found[name] for name in names if name in found},
    )


def _cut(exported: Exported, grey: np.ndarray, box: np.ndarray, kind: str, rotation: float) -> Crop | str:
    if np.isnan(box).all():
        return NO_BOX
    if complaint := box_problem(box, grey.shape):
        return complaint
    return cut_face(grey, *exported.placements[kind].face_in(box, rotation), exported.frame, rotation)
