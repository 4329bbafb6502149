"""The crops that a cascade works on, for those who call its jitted functions themselves."""

from collections.abc import Sequence
from contextlib import closing
from functools import partial

from numpy.typing import ArrayLike

from jaxfit.data.crops import Crops
from jaxfit.data.pictures import Images, Read, require_several
from jaxfit.data.threads import in_order, reading_threads
from jaxfit.fitting.fit import sources_of
from jaxfit.fitting.fits import Problem
from jaxfit.fitting.stream import Pipeline, cut_source
from jaxfit.models.model import SQUARE, Model


def crop_faces(
    model: Model,
    images: Images,
    boxes: ArrayLike,
    *,
    kind: str | Sequence[str] = SQUARE,
    read: Read | None = None,
) -> tuple[Crops, tuple[Problem, ...]]:
    """Cut the crops that the model's cascade works on.

    Args:
        model: whose crops.
        images: N pictures, as in ``jaxfit.fit``.
        boxes: (N, 4) x, y, width, height of the faces, in pixels.
        kind: what drew the boxes, one of ``model.known_placements``; or N of them.
        read: as in ``jaxfit.fit``. If it raises `jaxfit.errors.ImageError` or an `OSError`, this picture alone has a
            problem.

    Returns:
        The crops; and for each face that cannot be cut, whose crop is black, a problem.

    Raises:
        InputError: ``boxes`` is not (N, 4), or ``kind`` is unknown.
    """
    require_several(images)
    pipeline = Pipeline(model, read=read)
    sources = sources_of(model, images, boxes, kind)
    parts, problems, row = [Crops.empty(0, model.cascade.frame)], [], 0
    work = (partial(cut_source, pipeline, source) for source in sources)
    with closing(in_order(work, reading_threads(len(sources)))) as cut_sources:
        for source, (crops, why) in zip(sources, cut_sources, strict=True):
            parts.append(crops)
            problems += [Problem(row + face, source.name, reason, row + face) for face, reason in why.items()]
            row += len(crops)
    return Crops.join(parts), tuple(problems)
