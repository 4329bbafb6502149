"""Finding the faces of many pictures, in threads, without fitting them."""

from contextlib import closing
from dataclasses import dataclass
from functools import partial

import numpy as np

from jaxfit.data.detectors import DEFAULT_DETECTOR, Detector, Search, detector_named
from jaxfit.data.pictures import Images, Read, several
from jaxfit.data.threads import in_order, reading_threads
from jaxfit.fitting.fit import name_of
from jaxfit.fitting.fits import Problem
from jaxfit.fitting.sources import PictureFaces, Source, picture_faces
from jaxfit.types import Progress, silent


@dataclass(frozen=True, eq=False)
class Found:
    """The faces found in pictures, in their order.

    Attributes:
        pictures: (N,) int, the number of each face's picture.
        boxes: (N, 4) x, y, width, height, in pixels of the picture.
        kinds: what drew each box.
        rotations: (N,) how far each face is turned in its picture, in degrees, clockwise as seen.
        problems: of pictures without a face.
    """

    pictures: np.ndarray
    boxes: np.ndarray
    kinds: tuple[str, ...]
    rotations: np.ndarray
    problems: tuple[Problem, ...]


def find_faces(
    images: Images,
    detector: str | Detector = DEFAULT_DETECTOR,
    *,
    search: Search = Search(),
    read: Read | None = None,
    progress: Progress = silent,
) -> Found:
    """Look for faces in N pictures; one that cannot be used does not stop the others.

    Args:
        images: N pictures, as in ``jaxfit.fit``.
        detector: as in ``jaxfit.detect_faces``; its boxes must be of finite numbers.
        search: how faces are looked for, by detectors that come by name.
        read: makes an array of a file, in threads; by default pictures are turned upright as their EXIF data say.
        progress: called with the stage's name, pictures done and pictures in all.

    Raises:
        InputError: there is no such detector, or one picture comes instead of a sequence.
    """
    images = several(images)
    finder = detector_named(detector, search)
    sources = [Source(image, name_of(image)) for image in images]

    def faces_of(source: Source) -> PictureFaces:
        return picture_faces(source, finder, read)._replace(picture=None)

    found: list[PictureFaces] = []
    progress("finding faces", 0, len(sources))
    with closing(in_order((partial(faces_of, source) for source in sources), reading_threads(len(sources)))) as each:
        for one in each:
            found.append(one)
            progress("finding faces", len(found), len(sources))
    return Found(
        pictures=np.repeat(np.arange(len(found)), [len(one.boxes) for one in found]),
        boxes=np.concatenate([np.empty((0, 4)), *(one.boxes for one in found)]),
        kinds=tuple(kind for one in found for kind in one.kinds),
        rotations=np.concatenate([np.empty(0), *(one.rotations for one in found)]),
        problems=tuple(
            Problem(number, source.name, one.why)
            for number, (source, one) in enumerate(zip(sources, found, strict=True))
            if one.why
        ),
    )
