"""Fitting pictures: files or arrays in, landmarks out."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jaxfit.cascade.starts import Starts
from jaxfit.data.boxes import box_array, rotation_array
from jaxfit.data.detectors import Detector, Search
from jaxfit.data.pictures import Image, Images, Read, several
from jaxfit.errors import InputError
from jaxfit.fitting.batches import batch_sizes, compile_batches
from jaxfit.fitting.fits import Fits
from jaxfit.fitting.pipeline import Fitting, Pipeline
from jaxfit.fitting.sources import Source
from jaxfit.fitting.stream import stream
from jaxfit.models.model import SQUARE, Model
from jaxfit.types import Progress, silent


def fit(
    model: Model,
    images: Images,
    boxes: ArrayLike | None = None,
    *,
    kind: str | Sequence[str] = SQUARE,
    rotations: ArrayLike | None = None,
    detector: str | Detector | None = None,
    search: Search = Search(),
    starts: Starts = Starts(),
    passes: int | None = None,
    read: Read | None = None,
    progress: Progress = silent,
) -> Fits:
    """Find the landmarks of faces, and with 3D models their 3D shapes and poses.

    Without boxes, all faces that a detector finds are fitted. With N boxes for N pictures, there is a fit for each box.
    A picture or box that cannot be used, or a picture without a face, does not stop the others: ``problems`` says what
    was wrong.

    Several faces are computed in threads, which take JAX's default device from the caller, but nothing else that
    context managers of JAX set.

    Args:
        model: from ``jaxfit.load``.
        images: pictures, in a list, an array or a generator, which is kept as a list: their files, which are read while
            others are fitted, the bytes of such files, uint8 or uint16 arrays of NumPy or JAX of any sizes, (H, W)
            grey, (H, W, 3) RGB or (H, W, 4) RGBA, or upright PIL images; for boxes of several faces in one picture
            give it several times, one after the other.
        boxes: (N, 4) x, y, width, height of the faces, in pixels; None finds them.
        kind: what drew the boxes: ``"square"``, the default, means squares around the landmarks;
            ``model.known_placements`` has all kinds that the model knows. One for all, or N of them.
        rotations: (N,) how far the faces in the boxes are turned in the pictures, in degrees, clockwise as seen: they
            are cut out upright. None: all are upright.
        detector: what finds the faces if there are no boxes: as in ``jaxfit.detect_faces``, and by default
            ``"yunet"``, or ``"whole"`` for models of other objects.
        search: how faces are looked for if there are no boxes: the smallest face, the detector's score, any rotation.
        starts: how many starts each face has; several are worth their time if faces may be turned in the picture and
            the model was trained for it.
        passes: how often the cascade is run, each time from where the pass before found the face: a second pass makes
            up for rough boxes. By default once from given boxes, and as often as suits the detector from found ones.
        read: makes an array of a file, or of its bytes, in threads; by default, pictures are turned upright as their
            EXIF data say.
        progress: called with the stage's name, what is done and what there is to do.

    Raises:
        InputError: ``images`` is one picture, or nothing that pictures come in; ``boxes`` is not (N, 4), ``kind``,
            ``detector`` or ``search`` is unknown or not asked for, or there are no passes.
    """
    images, fitting = several(images), Fitting(detector, search, starts, passes)
    if boxes is None:
        if kind != SQUARE or rotations is not None:
            raise InputError(
                "expected boxes of this kind or with these rotations; without boxes, the detector says both"
            )
        pipeline = fitting.pipeline(model, read)
        sources = [Source(image, name_of(image)) for image in images]
        (fits,) = stream(pipeline, [sources], len(sources), progress)
        return fits
    pipeline = fitting.pipeline_in_boxes(model, read=read)
    sources = sources_of(model, images, boxes, kind, rotations)
    return fits_of_sources(pipeline, sources, progress)


def sources_of(
    model: Model,
    images: Sequence[Image],
    boxes: ArrayLike,
    kind: str | Sequence[str] = SQUARE,
    rotations: ArrayLike | None = None,
) -> list[Source]:
    """Pictures with a box each, as in `fit`; the same picture several times in a row becomes one source.

    Raises:
        InputError: ``boxes`` is not (N, 4), ``rotations`` is not (N,), or ``kind`` is unknown.
    """
    count = len(images)
    kinds = (kind,) * count if isinstance(kind, str) else tuple(kind)
    if len(kinds) != count:
        raise InputError(f"expected one kind of box, or one for each of {count} images; got {len(kinds)}")
    for each in {*kinds}:
        model.placement(each)
    array, turned = box_array(boxes, count), rotation_array(rotations, count)
    # The caller holds the pictures, so that no two have one id.
    identities = [str(image) if isinstance(image, str | Path) else id(image) for image in images]
    sources = []
    for _, numbers in groupby(range(count), identities.__getitem__):
        first, *others = numbers
        rows, image = slice(first, first + 1 + len(others)), images[first]
        sources.append(Source(image, name_of(image), array[rows], kinds[rows], turned[rows]))
    return sources


def fits_of_sources(pipeline: Pipeline, sources: Sequence[Source], progress: Progress) -> Fits:
    """The fits of pictures that come with boxes: a row for each box, as if it had come with a picture of its own."""
    (fits,) = stream(pipeline, [sources], len(sources), progress)
    problems = [replace(problem, picture=problem.row) for problem in fits.problems if problem.row is not None]
    return replace(
        fits,
        names=tuple(fits.names[number] for number in fits.pictures),
        sizes=fits.sizes[fits.pictures],
        pictures=np.arange(len(fits)),
        problems=tuple(problems),
    )


def name_of(image: Image) -> str:
    """What a picture is called in results: its file; empty for arrays and bytes."""
    return str(image) if isinstance(image, str | Path) else ""


def warm_up(model: Model, batches: Sequence[int] | None = None, starts: Starts = Starts(), passes: int = 1) -> None:
    """Compile the model for the batch sizes that `fit` uses, all by default; the first fit is then as fast as the next.

    Args:
        model: what to compile.
        batches: sizes of batches.
        starts: those of `fit`.
        passes: those of `fit`: 2 where it finds the faces by Haar.

    Raises:
        InputError: no passes.
    """
    compile_batches(Pipeline(model, starts=starts, passes=passes), batch_sizes() if batches is None else batches)
