"""Pictures and face boxes to the crops that a model works on; pictures are read and cut in threads, few at a time."""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from jaxfit.data.boxes import box_problem
from jaxfit.data.crops import Crops, cut
from jaxfit.data.images import read_upright, to_grey
from jaxfit.data.placements import Placement
from jaxfit.exceptions import ImageError, InputError
from jaxfit.image.frame import Frame
from jaxfit.models.model import SQUARE, Model

_MOST_CORES = 8  # that are kept busy; each thread holds a picture
_TOGETHER = 16  # faces that a thread cuts before it gives them to whoever waits

Image = np.ndarray | str | Path | bytes
Images = Sequence[Image] | np.ndarray
Read = Callable[[Any], np.ndarray]  # of a Path or bytes; bytes only where pictures come as such
T = TypeVar("T")

_most_cores: ContextVar[int | None] = ContextVar("most_cores", default=None)


@dataclass(frozen=True, eq=False)
class CutFaces:
    """Some faces, cut from their pictures.

    Attributes:
        numbers: of the faces.
        crops: one for each; black where a face could not be cut.
        problems: of those, the number and why.
        sources: for each, how problems begin: with the name of its picture's file, if it came from one.
    """

    numbers: range
    crops: Crops
    problems: dict[int, str]
    sources: list[str]


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
    faces = faces_to_cut(model, images, boxes, kind, read)
    crops = Crops.empty(len(faces), faces.frame)
    problems: dict[int, str] = {}
    with closing(in_order(cutting(faces, repeat(_TOGETHER)), reading_threads(len(faces)))) as cut_parts:
        for part in cut_parts:
            rows = slice(part.numbers.start, part.numbers.stop)
            for of_all, of_part in zip(crops.arrays, part.crops.arrays, strict=True):
                of_all[rows] = of_part
            problems |= part.problems
    return crops, problems


@dataclass(frozen=True, eq=False)
class Faces:
    """Faces that are to be cut, made by `faces_to_cut`, which checks them.

    Attributes:
        frame: of the crops.
        images: one for each face.
        boxes: (N, 4).
        kinds: what drew each box.
        placements: how faces lie in each box.
        read: makes an array of a file.
    """

    frame: Frame
    images: Images
    boxes: np.ndarray
    kinds: tuple[str, ...]
    placements: Sequence[Placement]
    read: Read

    def __len__(self) -> int:
        return len(self.images)


def faces_to_cut(model: Model, images: Images, boxes: ArrayLike, kind: str | Sequence[str], read: Read) -> Faces:
    """The faces that `crop_faces` cuts, with the same arguments.

    Raises:
        InputError: as `crop_faces`.
    """
    require_several(images)
    kinds = (kind,) * len(images) if isinstance(kind, str) else tuple(kind)
    if len(kinds) != len(images):
        raise InputError(f"expected one kind of box, or one for each of {len(images)} images; got {len(kinds)}")
    placements = {kind: model.placement(kind) for kind in {SQUARE, *kinds}}
    boxes = _box_array(boxes, len(images))
    return Faces(model.cascade.frame, images, boxes, kinds, [placements[kind] for kind in kinds], read)


def cutting(faces: Faces, sizes: Iterable[int]) -> Iterator[Callable[[], CutFaces]]:
    """The work of `crop_faces` in parts, of so many faces each, to be done in any threads.

    A picture is read once for faces that follow one another, also where they belong to several parts.
    """
    picture: _Picture | None = None
    first = 0
    for size in sizes:
        numbers = range(first, min(first + size, len(faces)))
        if not numbers:
            return
        pictures: deque[_Picture] = deque()
        for number in numbers:
            image = faces.images[number]
            if picture is None or not _same(picture.image, image):
                picture = _Picture(image, faces.read)
            pictures.append(picture)
        yield partial(_cut, faces, numbers, pictures)
        first = numbers.stop


def require_several(images: Images) -> None:
    """Check that pictures are a sequence of them.

    Raises:
        InputError: it is one picture.
    """
    if isinstance(images, np.ndarray) and (images.ndim == 2 or (images.shape[-1] in (3, 4) and images.ndim == 3)):
        raise InputError(f"expected a sequence of images, got one array {images.shape}; put it in a list")
    if isinstance(images, str | Path):
        raise InputError(f"expected a sequence of images, got {str(images)!r}; put it in a list")
    if isinstance(images, bytes):
        raise InputError(f"expected a sequence of images, got {len(images)} bytes; put them in a list")


def pixels(image: Image, read: Read) -> np.ndarray:
    """The pixels of a picture, read if it is a file or the bytes of one."""
    if isinstance(image, bytes):
        return read(image)
    return read(Path(image)) if isinstance(image, str | Path) else image


class _Picture:
    """A picture that is read when the first of its faces is cut, by whichever thread comes first, and not again."""

    def __init__(self, image: Image, read: Read):
        self.image, self._read = image, read
        self.source = f"{image}: " if isinstance(image, str | Path) else ""
        self._lock = Lock()
        self._grey: np.ndarray | str | None = None

    def grey(self) -> np.ndarray | str:
        """Its pixels, uint8 (H, W), or why it has none."""
        with self._lock:
            if self._grey is None:
                try:
                    self._grey = to_grey(pixels(self.image, self._read))
                except (ImageError, OSError) as error:
                    named = self.source and str(self.image) in str(error)
                    self._grey = str(error) if named else f"{self.source}{error}"
            return self._grey


def _cut(faces: Faces, numbers: range, pictures: deque[_Picture]) -> CutFaces:
    """Cut these faces from their pictures, which are forgotten one after the other."""
    crops = Crops.empty(len(numbers), faces.frame)
    problems: dict[int, str] = {}
    sources = [picture.source for picture in pictures]
    boxless = np.isnan(faces.boxes[numbers.start : numbers.stop]).all(1)
    for row, number in enumerate(numbers):
        picture, box = pictures.popleft(), faces.boxes[number]
        if boxless[row]:
            problems[number] = f"{sources[row]}there is no face box"
            continue
        grey = picture.grey()
        if isinstance(grey, str):
            problems[number] = grey
        elif complaint := box_problem(box, grey.shape):
            problems[number] = f"{sources[row]}{complaint}"
        else:
            cut(grey, *faces.placements[number].face_in(box), crops, row)
    return CutFaces(numbers, crops, problems, sources)


def _same(one: Image, other: Image) -> bool:
    return one is other or (isinstance(one, str | Path) and isinstance(other, str | Path) and str(one) == str(other))


def in_order(work: Iterable[Callable[[], T]], threads: int) -> Generator[T, None, None]:
    """What pieces of work give, one after the other, while threads, if there are any, do the next ones.

    Close it if no more is wanted: what has not begun is then not done.
    """
    if threads == 0:
        yield from (piece() for piece in work)
        return
    pool = ThreadPoolExecutor(threads)
    waiting: deque[Future[T]] = deque()
    try:
        for piece in work:
            waiting.append(pool.submit(piece))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def reading_threads(count: int) -> int:
    """How many threads read and cut ``count`` faces: one more than keep the cores busy, as they wait for one another;
    none for a single face, which would take as long again to wake one."""
    return min(_MOST_CORES, cores()) + 1 if count > 1 else 0


def cores() -> int:
    """How many this process may use, or fewer within `at_most_cores`."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(there, _most_cores.get() or there)


@contextmanager
def at_most_cores(count: int) -> Iterator[None]:
    """Fit with threads for so many cores only, where other processes have the others."""
    token = _most_cores.set(count)
    try:
        yield
    finally:
        _most_cores.reset(token)


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
