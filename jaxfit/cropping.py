"""Pictures and face boxes to the crops that a model works on; pictures are read and cut ahead, in threads."""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxfit.data.boxes import box_problem
from jaxfit.data.crops import Crop, Crops, cut_face
from jaxfit.data.images import read_upright, to_grey
from jaxfit.exceptions import ImageError, InputError
from jaxfit.models.model import SQUARE, Model

# Pictures that are read and cut before they are asked for: their crops wait, the pictures do not.
_AHEAD = 128
_MOST_THREADS = 8  # each holds a picture
_TOGETHER = 64  # faces of a picture that are cut while it is held

Images = Sequence[np.ndarray | str | Path] | np.ndarray
Read = Callable[[Path], np.ndarray]


class CutFace(NamedTuple):
    """A face's crop, or why there is none.

    Attributes:
        number: of the face.
        source: how problems of its picture begin: with the file's name, if it is one.
        crop: None if it could not be cut.
        problem: why not; empty if it could.
    """

    number: int
    source: str
    crop: Crop | None
    problem: str = ""


def crop_faces(
    model: Model, images: Images, boxes: ArrayLike, kind: str | Sequence[str] = SQUARE, read: Read = read_upright
) -> tuple[Crops, dict[int, str]]:
    """Cut the crops that the model's cascade works on.

    Args:
        model: whose crops.
        images: N pictures: their files, or uint8 arrays of any sizes, (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA; the
            same may come several times, once for each of its faces.
        boxes: (N, 4) x, y, width, height of the faces, in pixels.
        kind: what drew the boxes, one of ``model.placements``; or N of them.
        read: what makes an array of a file, in threads; unless told, pictures are turned upright as EXIF data say.
            If it raises `jaxfit.ImageError` or an `OSError`, this picture alone has a problem.

    Returns:
        The crops; and for each face that cannot be cut (its crop is black) its number and why.

    Raises:
        InputError: ``boxes`` is not (N, 4), or ``kind`` is unknown.
    """
    crops = Crops.empty(len(images), model.cascade.frame)
    problems: dict[int, str] = {}
    with closing(cut_faces(model, images, boxes, kind, read)) as faces:
        for face in faces:
            if face.crop is None:
                problems[face.number] = face.problem
            else:
                crops.pixels[face.number], crops.scale[face.number], crops.offset[face.number] = face.crop
    return crops, problems


def cut_faces(
    model: Model, images: Images, boxes: ArrayLike, kind: str | Sequence[str], read: Read
) -> Generator[CutFace, None, None]:
    """The crops of `crop_faces` one after the other; some pictures' exist at a time, of pictures one a thread.

    Raises:
        InputError: as `crop_faces`, before anything is read.
    """
    if isinstance(images, np.ndarray) and (images.ndim == 2 or (images.shape[-1] in (3, 4) and images.ndim == 3)):
        raise InputError(f"expected a sequence of images, got one array {images.shape}; put it in a list")
    if isinstance(images, str | Path):
        raise InputError(f"expected a sequence of images, got {str(images)!r}; put it in a list")
    images = list(images) if isinstance(images, np.ndarray) else images
    boxes = _box_array(boxes, len(images))
    kinds = [kind] * len(images) if isinstance(kind, str) else list(kind)
    if len(kinds) != len(images):
        raise InputError(f"expected one kind of box, or one for each of {len(images)} images; got {len(kinds)}")
    placements = [model.placement(kind) for kind in kinds]

    def of_picture(picture: _Picture) -> list[CutFace]:
        image, numbers = picture
        source = f"{image}: " if isinstance(image, str | Path) else ""
        try:
            grey = _grey(image, read)
        except (ImageError, OSError) as error:
            why = str(error) if str(image) in str(error) else f"{source}{error}"
            return [CutFace(number, source, None, why) for number in numbers]
        found = []
        for number in numbers:
            if complaint := box_problem(boxes[number], grey.shape):
                found.append(CutFace(number, source, None, f"{source}{complaint}"))
            else:
                centre, side = placements[number].face_in(boxes[number])
                found.append(CutFace(number, source, cut_face(grey, centre, side, model.cascade.frame)))
        return found

    if len(images) == 1:  # which threads would only keep waiting
        return (face for picture in _pictures(images) for face in of_picture(picture))
    return _in_threads(of_picture, _pictures(images))


class _Picture(NamedTuple):
    """A picture and the numbers of its faces."""

    image: np.ndarray | str | Path
    numbers: list[int]


def _grey(image: np.ndarray | str | Path, read: Read) -> np.ndarray:
    return to_grey(read(Path(image)) if isinstance(image, str | Path) else image)


def _pictures(images: Images) -> Iterator[_Picture]:
    """The pictures one after the other, each with those of its faces that follow one another, some at a time."""
    picture: _Picture | None = None
    for number in range(len(images)):
        image = images[number]
        same = picture is not None and len(picture.numbers) < _TOGETHER and _same(picture.image, image)
        if picture is not None and same:
            picture.numbers.append(number)
            continue
        if picture is not None:
            yield picture
        picture = _Picture(image, [number])
    if picture is not None:
        yield picture


def _same(one: np.ndarray | str | Path, other: np.ndarray | str | Path) -> bool:
    return one is other or (isinstance(one, str | Path) and isinstance(other, str | Path) and str(one) == str(other))


def _in_threads(
    work: Callable[[_Picture], list[CutFace]], pictures: Iterator[_Picture]
) -> Generator[CutFace, None, None]:
    """What ``work`` makes of each picture, in order, some of it ahead of time."""
    pool = ThreadPoolExecutor(min(_MOST_THREADS, cores()))
    waiting: deque[Future[list[CutFace]]] = deque()
    try:
        for picture in pictures:
            waiting.append(pool.submit(work, picture))
            if len(waiting) >= _AHEAD:
                yield from waiting.popleft().result()
        while waiting:
            yield from waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)  # someone may want no more


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _box_array(boxes: ArrayLike, count: int) -> np.ndarray:
    try:
        array = np.asarray(boxes, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"expected boxes as an array ({count}, 4) of numbers; got {boxes!r}") from None
    # No faces, no boxes: an empty list is as good as an empty (0, 4) array.
    if count == 0 and array.size == 0:
        return array.reshape(0, 4)
    if array.shape != (count, 4):
        raise InputError(
            f"expected one box (x, y, width, height) for each of {count} images, an array ({count}, 4); "
            f"got an array {array.shape}"
        )
    return array
