"""The first half of the stream: a picture is read once, its faces are found unless they are known, and cut."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfit.data.boxes import box_problem
from jaxfit.data.crops import Crop, cut_face
from jaxfit.data.detectors import Detector
from jaxfit.data.limits import counted_together
from jaxfit.data.pictures import Image, Read, pixels, read_grey, read_image, to_eight_bits, to_grey
from jaxfit.errors import ImageError
from jaxfit.fitting.pipeline import Pipeline
from jaxfit.models.model import Model

NO_FACE = "no face found; give face boxes, or take another detector"  # the problem of a picture without one
NO_BOX = "there is no face box"


class Source(NamedTuple):
    """A picture that is to be fitted.

    Attributes:
        image: its file, the bytes of one, or its pixels.
        name: what it is called in results; empty for arrays.
        boxes: (n, 4) of its faces; None: they are looked for.
        kinds: what drew each box.
        rotations: (n,) how far each face is turned in the picture, in degrees, clockwise as seen; None: not at all.
    """

    image: Image
    name: str = ""
    boxes: np.ndarray | None = None
    kinds: tuple[str, ...] = ()
    rotations: np.ndarray | None = None


class PictureFaces(NamedTuple):
    """A picture that was read, and its faces.

    Attributes:
        picture: uint8 (H, W) grey or (H, W, 3) RGB; None if it cannot be used.
        boxes: (n, 4) of its faces.
        kinds: what drew them.
        rotations: (n,) how far each face is turned, in degrees.
        why: why there is no face in it; empty if there are some.
    """

    picture: np.ndarray | None
    boxes: np.ndarray
    kinds: tuple[str, ...]
    rotations: np.ndarray
    why: str = ""


def picture_faces(source: Source, detector: Detector | None, read: Read | None) -> PictureFaces:
    """Read a picture, once, and find its faces unless they are known; arguments are those of `Pipeline`."""
    searching = detector if source.boxes is None else None
    boxes = np.empty((0, 4)) if source.boxes is None else source.boxes
    rotations = np.zeros(len(boxes)) if source.rotations is None else source.rotations
    if source.boxes is not None and all(map(_is_unknown, boxes)):
        # Not read: nothing would be done with it.
        return PictureFaces(None, boxes, source.kinds, rotations, NO_BOX)
    if read is None:
        read = read_image if searching is not None and searching.colour else read_grey
    image = source.image
    try:
        picture = to_eight_bits(pixels(image, read))
        if searching is None:
            return PictureFaces(picture, boxes, source.kinds, rotations, "" if len(boxes) else NO_BOX)
        picture = picture if searching.colour else to_grey(picture)
        found = searching(picture)
    except (ImageError, OSError) as error:
        why = str(error).removeprefix(f"{Path(image)}: ") if isinstance(image, str | Path) else str(error)
        return PictureFaces(None, boxes, source.kinds, rotations, why)
    return PictureFaces(
        picture,
        np.array([face.box for face in found], np.float64).reshape(-1, 4),
        tuple(face.kind for face in found),
        np.array([face.rotation for face in found]),
        "" if found else NO_FACE,
    )


class CutPicture(NamedTuple):
    """A picture that was read, and the crops of its faces.

    Attributes:
        size: its width and height; zeros if it could not be read.
        boxes: (n, 4) of its faces.
        kinds: what drew them.
        rotations: (n,) how far each face is turned, in degrees.
        faces: the crop of each, or why it could not be cut.
        why: why there is no face in the picture; empty if there are some.
    """

    size: tuple[int, int]
    boxes: np.ndarray
    kinds: tuple[str, ...]
    rotations: np.ndarray
    faces: Sequence[Crop | str]
    why: str = ""


def cut_picture(pipeline: Pipeline, source: Source) -> CutPicture:
    """Read a picture, find its faces unless they are known, and cut them."""
    with counted_together():
        picture, boxes, kinds, rotations, why = picture_faces(source, pipeline.detector, pipeline.read)
        if picture is None:
            return CutPicture((0, 0), boxes, kinds, rotations, [why] * len(boxes), why)
        faces = [_cut(pipeline.model, picture, *face) for face in zip(boxes, kinds, rotations, strict=True)]
    return CutPicture((picture.shape[1], picture.shape[0]), boxes, kinds, rotations, faces, why)


def _cut(model: Model, picture: np.ndarray, box: np.ndarray, kind: str, degrees: float) -> Crop | str:
    """The crop of the face in a box (4,), turned by so much, of a picture, uint8 (H, W, ...); or why there is none."""
    if _is_unknown(box):
        return NO_BOX
    if complaint := box_problem(box, picture.shape):
        return complaint
    rotation = math.radians(degrees)
    return cut_face(picture, *model.placement(kind).face_in(box, rotation), model.cascade.frame, rotation)


def _is_unknown(box: np.ndarray) -> bool:
    """Whether a box (4,) is missing; plain numbers, because arrays of four take long."""
    return all(map(math.isnan, box.tolist()))
