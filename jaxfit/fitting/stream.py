"""The one way from pictures to fits: read, find faces, cut crops, fit batches.

    groups of pictures -> read (once) -> find faces -> cut -> batches of crops -> Fits of each group

Every call, command and worker that fits goes through here. Threads read and look through pictures, others compute
batches, and what they give comes back in order. A few pictures and batches are in memory at a time, however many there
are.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from functools import partial
from threading import Lock, Semaphore
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfit.data.crops import Crops
from jaxfit.data.threads import in_order, reading_threads
from jaxfit.fitting.batches import batch_computation, batch_sizes, batches_of, computed_at_once, least_batches
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.fitting.pipeline import Pipeline
from jaxfit.fitting.sources import CutPicture, Source, cut_picture
from jaxfit.models.model import Model
from jaxfit.modes import computing
from jaxfit.shapes.pose_order import turned_poses
from jaxfit.types import Progress, silent

_FOUND_TOGETHER = 4  # pictures that a thread looks through before it hands them on

_Found = dict[str, np.ndarray]  # what is found in a batch, by its name in `Fits`


def stream(
    pipeline: Pipeline,
    groups: Iterable[Sequence[Source]],
    pictures: int,
    progress: Progress = silent,
) -> Generator[Fits, None, None]:
    """The fits of each group of pictures, in order, while later groups are already looked through.

    No batch has faces of two groups: what is found in a group does not depend on the groups around it, to the bit.
    Threads take JAX's default device from the caller, but nothing else that context managers of JAX set.

    Args:
        pipeline: how pictures are fitted.
        groups: of pictures, with boxes that are known to the model.
        pictures: how many there are in all groups.
        progress: called with the stage's name, pictures looked through and pictures in all.
    """
    threads, frame = reading_threads(pictures), pipeline.model.cascade.frame
    compute, free = batch_computation(pipeline), Semaphore(computed_at_once())
    device: Any = getattr(jax.config, "jax_default_device")  # noqa: B009 - not in its stubs; threads do not know it
    done = 0

    def report(some: Sequence[_Picture]) -> None:
        nonlocal done
        done += len(some)
        progress("fitting", done, pictures)

    @computing
    def fit_batch(batch: _Batch) -> tuple[_Batch, _Found]:
        cut = [picture.cut().faces[number] for picture, number in batch.faces]
        if all(isinstance(crop, str) for crop in cut):
            return batch, {}
        crops = Crops.of(cut, frame)
        with free, jax.default_device(device):
            found = {name: np.asarray(values) for name, values in compute(crops.pixels).items()}
        return batch, in_pictures(crops, found)

    report([])
    with (
        closing(in_order(_parts(pipeline, groups), threads)) as parts,
        closing(_batches(pipeline.model, parts, report)) as batches,
        closing(in_order((partial(fit_batch, batch) for batch in batches), threads)) as computed,
    ):
        for batch, found in computed:
            batch.group.put(batch, found)
            report([picture for picture in batch.pictures if not picture.searched])
            if batch.last:
                yield batch.group.fits()


class _Picture:
    """A picture that is read, looked through and cut by whichever thread first asks for it, and only once.

    Attributes:
        name: what it is called.
        searched: whether its faces are looked for.
    """

    def __init__(self, pipeline: Pipeline, source: Source):
        self.name, self.searched = source.name, source.boxes is None
        self._source, self._pipeline = source, pipeline
        self._cut: CutPicture | None = None
        self._lock = Lock()

    def cut(self) -> CutPicture:
        """The picture's faces and their crops."""
        with self._lock:
            if self._cut is None:
                self._cut = cut_picture(self._pipeline, self._source)
            return self._cut

    def __len__(self) -> int:
        """How many faces it has; where they are looked for, it has to be read."""
        return len(self.cut().boxes if self._source.boxes is None else self._source.boxes)


class _Part(NamedTuple):
    """Some pictures of a group, and whether they are its last."""

    pictures: list[_Picture]
    last: bool


def _parts(pipeline: Pipeline, groups: Iterable[Sequence[Source]]) -> Iterator[Callable[[], _Part]]:
    """The work of looking through pictures, a few of one group at a time.

    Where all faces of a group are known, whoever fits them reads the pictures: to hand them over takes time.
    """

    def part_of(sources: Sequence[Source], last: bool) -> _Part:
        some = [_Picture(pipeline, source) for source in sources]
        for picture in some:
            if picture.searched:
                picture.cut()
        return _Part(some, last)

    for group in groups:
        searched = any(source.boxes is None for source in group)
        together = _FOUND_TOGETHER if searched else max(1, len(group))
        for first in range(0, max(1, len(group)), together):
            yield partial(part_of, group[first : first + together], first + together >= len(group))


class _Face(NamedTuple):
    """A face of a picture, by its number there."""

    picture: _Picture
    number: int


class _Batch(NamedTuple):
    """Some faces of a group, which are fitted together.

    Attributes:
        group: whose faces.
        faces: in the order of the group's.
        pictures: the pictures that begin with these faces, or have none.
        last: whether they are the group's last.
    """

    group: "_Group"
    faces: list[_Face]
    pictures: list[_Picture]
    last: bool


def _batches(
    model: Model, parts: Iterable[_Part], report: Callable[[Sequence[_Picture]], None]
) -> Generator[_Batch, None, None]:
    """Batches of the sizes that are compiled, large ones first; searched pictures are reported when they come.

    A group's faces are split as `batches_of` splits their number; large batches do not wait for the group's end.
    """
    group = _Group(model)
    large = batch_sizes()[0]
    enough = several = large * least_batches(large)  # waiting faces from which large batches are used
    for part in parts:
        for picture in part.pictures:
            group.add(picture)
            while group.waiting >= enough:
                enough = large
                yield group.take(large)
        report([picture for picture in part.pictures if picture.searched])
        if part.last:
            sizes = batches_of(group.waiting) or [0]
            for number, size in enumerate(sizes, 1):
                yield group.take(size, last=number == len(sizes))
            group, enough = _Group(model), several


class _Group:
    """What is known of a group's pictures and faces, filled in as it comes."""

    def __init__(self, model: Model):
        self._model = model
        self._faces: deque[_Face | _Picture] = deque()  # that wait for a batch; pictures stand before their faces
        self.waiting = 0  # faces
        self._names: list[str] = []
        self._sizes: list[tuple[int, int]] = []
        self._boxes: list[np.ndarray] = [np.empty((0, 4))]
        self._kinds: list[str] = []
        self._rotations: list[np.ndarray] = [np.empty(0)]
        self._pictures: list[int] = []
        self._problems: list[Problem] = []
        self._found: list[_Found] = [self._nothing(0)]

    def add(self, picture: _Picture) -> None:
        """A picture, whose faces wait for a batch."""
        self._faces.append(picture)
        self._faces += [_Face(picture, number) for number in range(len(picture))]
        self.waiting += len(picture)

    def take(self, count: int, last: bool = False) -> _Batch:
        """The next batch of faces; the last batch has the pictures behind them, too."""
        batch = _Batch(self, [], [], last)
        while self._faces and (len(batch.faces) < count or last):
            face = self._faces.popleft()
            if isinstance(face, _Picture):
                batch.pictures.append(face)
            else:
                batch.faces.append(face)
        self.waiting -= count
        return batch

    def put(self, batch: _Batch, found: _Found) -> None:
        """What was found in a batch; batches come in order."""
        for picture in batch.pictures:
            cut, number, first = picture.cut(), len(self._names), len(self._pictures)
            self._names.append(picture.name)
            self._sizes.append(cut.size)
            self._boxes.append(cut.boxes)
            self._kinds += cut.kinds
            self._rotations.append(cut.rotations)
            self._pictures += [number] * len(cut.boxes)
            if not len(cut.boxes):
                self._problems.append(Problem(number, picture.name, cut.why))
            for row, face in enumerate(cut.faces, first):
                if isinstance(face, str):
                    self._problems.append(Problem(number, picture.name, face, row))
        self._found.append(found or self._nothing(len(batch.faces)))

    def _nothing(self, count: int) -> _Found:
        """What is found of faces that could not be cut."""
        return {name: np.full((count, *shape), np.nan) for name, shape in _shapes(self._model).items()}

    def fits(self) -> Fits:
        """The fits, when all batches have come."""
        arrays = {name: np.concatenate([found[name] for found in self._found]) for name in self._nothing(0)}
        finite = np.all([np.isfinite(values).all((*range(1, values.ndim),)) for values in arrays.values()], 0)
        known = [problem.row for problem in self._problems if problem.row is not None]
        finite[known] = False
        for values in arrays.values():
            values[~finite] = np.nan
        diverged = sorted({*map(int, np.flatnonzero(~finite))} - {*known})
        problems = self._problems + [
            Problem(self._pictures[row], self._names[self._pictures[row]], "the fit diverged", row) for row in diverged
        ]
        return Fits(
            scheme=self._model.scheme,
            names=tuple(self._names),
            sizes=np.array(self._sizes, int).reshape(-1, 2),
            pictures=np.array(self._pictures, int),
            boxes=np.concatenate(self._boxes),
            kinds=tuple(self._kinds),
            rotations=np.concatenate(self._rotations),
            problems=tuple(sorted(problems, key=lambda problem: (problem.picture, problem.row or 0))),
            **arrays,
        )


def _shapes(model: Model) -> dict[str, tuple[int, ...]]:
    """The shape of what is found of one face, by its name in `Fits`."""
    shapes: dict[str, tuple[int, ...]] = {"landmarks": (model.scheme.count, 2)}
    if model.space_3d is not None:
        shapes |= {"landmarks_3d": (model.scheme.count, 3), "pose": (3,), "scale": (), "b": (model.space_3d.modes,)}
    if model.confidence is not None:
        shapes["confidence"] = ()
    if model.uncertainty is not None:
        shapes |= {"covariances": (model.scheme.count, 2, 2), "visible": (model.scheme.count,)}
    return shapes


def in_pictures(crops: Crops, found: _Found) -> _Found:
    """What was found in crops, in the pixels of the pictures, float64."""
    found = {name: values.astype(np.float64) for name, values in found.items()}
    found["landmarks"] = crops.to_images(found["landmarks"])
    if "landmarks_3d" in found:
        flat = crops.to_images(found["landmarks_3d"][..., :2])
        depths = found["landmarks_3d"][..., 2:] * crops.scale[:, None, None]
        found |= {"landmarks_3d": np.concatenate([flat, depths], -1), "scale": found["scale"] * crops.scale}
        found["pose"] = turned_poses(found["pose"], np.degrees(crops.rotation))
    if "covariances" in found:
        found["covariances"] = crops.covariances_to_images(found["covariances"])
    return found
