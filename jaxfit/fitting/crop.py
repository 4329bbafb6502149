"""The crops that a cascade works on, for those who call its jitted functions themselves."""

from collections.abc import Sequence
from contextlib import closing
from functools import partial

from numpy.typing import ArrayLike

from jaxfit.data.crops import Crop, Crops
from jaxfit.data.pictures import Images, Read, several
from jaxfit.data.threads import in_order, reading_threads
from jaxfit.fitting.fit import name_of, sources_of
from jaxfit.fitting.fits import Problem
from jaxfit.fitting.pipeline import Pipeline
from jaxfit.fitting.sources import Source, cut_picture
from jaxfit.models.model import SQUARE, Model

_TOGETHER = 16  # pictures that a thread cuts before it hands them on


def crop_faces(
    model: Model,
    images: Images,
    boxes: ArrayLike,
    *,
    kind: str | Sequence[str] = SQUARE,
    rotations: ArrayLike | None = None,
    read: Read | None = None,
) -> tuple[Crops, tuple[Problem, ...]]:
    """Cut out the faces as crops, which the model's cascade works on.

    Args:
        model: whose crops.
        images: N pictures, as in ``jaxfit.fit``.
        boxes: (N, 4) x, y, width, height of the faces, in pixels.
        kind: what drew the boxes, one of ``model.known_placements``; or N of them.
        rotations: (N,) how far the faces are turned, as in ``jaxfit.fit``: their crops are upright.
        read: as in ``jaxfit.fit``. If it raises `jaxfit.errors.ImageError` or an `OSError`, this picture alone has a
            problem.

    Returns:
        The crops, and a problem for each face that cannot be cut; its crop is black.

    Raises:
        InputError: ``boxes`` is not (N, 4), ``rotations`` is not (N,), or ``kind`` is unknown.
    """
    images = several(images)
    pipeline = Pipeline(model, read=read)
    sources = sources_of(model, images, boxes, kind, rotations)
    work = (partial(_cut_some, pipeline, sources[at : at + _TOGETHER]) for at in range(0, len(sources), _TOGETHER))
    faces: list[Crop | str] = []
    with closing(in_order(work, reading_threads(len(sources)))) as parts:
        for part in parts:
            faces += part
    problems = tuple(
        Problem(row, name_of(images[row]), face, row) for row, face in enumerate(faces) if isinstance(face, str)
    )
    return Crops.of(faces, model.cascade.frame), problems


def _cut_some(pipeline: Pipeline, sources: Sequence[Source]) -> list[Crop | str]:
    return [face for source in sources for face in cut_picture(pipeline, source).faces]
