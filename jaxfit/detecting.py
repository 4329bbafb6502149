"""Finding the faces of many pictures, in threads, before they are fitted."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from jaxfit.cropping import Image, Images, Read, in_order, pixels, reading_threads, require_several
from jaxfit.data.detectors import DEFAULT_DETECTOR, Detection, Detector, detector_named
from jaxfit.data.images import read_image, to_eight_bits
from jaxfit.exceptions import ImageError

NO_FACE = "no face found; give face boxes, or take another detector"  # how the problem of a picture without one ends
_TOGETHER = 4  # pictures that a thread looks at before it gives what it found to whoever waits


@dataclass(frozen=True)
class Found:
    """The faces found in pictures, in their order.

    Attributes:
        pictures: (N,) int, the number of each face's picture.
        boxes: (N, 4) x, y, width, height, in pixels of the picture.
        kinds: what drew each box.
        problems: for each picture without a face, its number and why.
    """

    pictures: np.ndarray
    boxes: np.ndarray
    kinds: tuple[str, ...]
    problems: dict[int, str]


def find_faces(
    images: Images,
    detector: str | Detector = DEFAULT_DETECTOR,
    *,
    read: Read = read_image,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Found:
    """Look for faces in N pictures; one that cannot be used does not stop the others.

    Args:
        images: N pictures, as in ``jaxfit.fit``.
        detector: as in ``jaxfit.detect_faces``; its boxes should be of finite numbers, for nobody checks them.
        read: makes an array of a file, in threads; unless told, pictures are turned upright as their EXIF data say.
        progress: called with the stage's name, pictures done and pictures in all.

    Raises:
        InputError: there is no such detector, or one picture comes instead of a sequence.
    """
    require_several(images)
    find = detector_named(detector) if isinstance(detector, str) else detector
    faces: list[tuple[int, Detection]] = []
    problems: dict[int, str] = {}

    def parts() -> Iterator[Callable[[], list[list[Detection] | str]]]:
        for first in range(0, len(images), _TOGETHER):
            some = [images[number] for number in range(first, min(first + _TOGETHER, len(images)))]
            yield partial(_found, find, some, read)

    number = 0
    progress("finding faces", 0, len(images))
    with closing(in_order(parts(), reading_threads(len(images)))) as results:
        for result in results:
            for in_picture in result:
                if isinstance(in_picture, str):
                    problems[number] = in_picture
                else:
                    faces += [(number, face) for face in in_picture]
                number += 1
            progress("finding faces", number, len(images))
    boxes = np.array([face.box for _, face in faces], np.float64).reshape(-1, 4)
    return Found(np.array([n for n, _ in faces], int), boxes, tuple(face.kind for _, face in faces), problems)


def _found(find: Detector, images: Sequence[Image], read: Read) -> list[list[Detection] | str]:
    """The faces of each picture, or why there are none."""
    return [_found_in(find, image, read) for image in images]


def _found_in(find: Detector, image: Image, read: Read) -> list[Detection] | str:
    source = f"{image}: " if isinstance(image, str | Path) else ""
    try:
        faces = find(to_eight_bits(pixels(image, read)))
    except (ImageError, OSError) as error:
        return str(error) if source and str(image) in str(error) else f"{source}{error}"
    return faces or f"{source}{NO_FACE}"
