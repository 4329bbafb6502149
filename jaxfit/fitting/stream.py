"""The one way from pictures to fits: read, find faces, cut crops, fit batches.

    groups of pictures -> read (once) -> find faces -> cut -> batches of crops -> Fits of each group

Every call, command and worker that fits goes through here. Threads read and look through pictures, others compute
batches, and what they give comes back in order. A few pictures and batches are in memory at a time, however many there
are.
"""

import math
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from functools import cache, partial
from pathlib import Path
from threading import Lock, Semaphore
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jaxfit.cascade.confidence import Confidence
from jaxfit.cascade.fit import find
from jaxfit.cascade.model import Cascade
from jaxfit.data.boxes import box_problem
from jaxfit.data.crops import Crop, Crops, cut_face
from jaxfit.data.detectors import Detector
from jaxfit.data.limits import counted_together
from jaxfit.data.pictures import Image, Read, pixels, read_grey, read_image, to_eight_bits, to_grey
from jaxfit.data.threads import cores, in_order, reading_threads
from jaxfit.errors import ImageError
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.fitting.pipeline import Pipeline
from jaxfit.models.model import Model
from jaxfit.modes import computing
from jaxfit.shapes.pose_order import turned_poses
from jaxfit.shapes.space import ShapeSpace3D
from jaxfit.types import Progress, silent

# Any number of faces is served by batches of these sizes, so that there are three compilations. Where there are several
# devices there is one more: batches of the first size for each of them, all at once.
BATCHES = (64, 8, 1)
NO_FACE = "no face found; give face boxes, or take another detector"  # the problem of a picture without one
NO_BOX = "there is no face box"
_MOST_AT_ONCE = 8  # batches that are computed at once; each holds a batch and its descriptors
_FOUND_TOGETHER = 4  # pictures that a thread looks through before it hands them on

_Found = dict[str, np.ndarray]  # what is found in a batch, by its name in `Fits`


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
    compute, free = _computing(pipeline), Semaphore(computed_at_once())
    device: Any = getattr(jax.config, "jax_default_device")  # noqa: B009 - not in its stubs; threads do not know it
    done = 0

    def report(some: Sequence[_Picture]) -> None:
        nonlocal done
        done += len(some)
        progress("fitting", done, pictures)

    @computing
    def fit_batch(batch: _Batch) -> tuple[_Batch, _Found]:
        cut = [picture.look().faces[number] for picture, number in batch.faces]
        if all(isinstance(crop, str) for crop in cut):
            return batch, {}
        crops = Crops.of(cut, frame)
        with free, jax.default_device(device):
            found = {name: np.asarray(values) for name, values in compute(crops.pixels).items()}
        return batch, in_pictures(crops, found)

    report([])
    with (
        closing(in_order(_looking(pipeline, groups), threads)) as looked,
        closing(_batches(pipeline.model, looked, report)) as batches,
        closing(in_order((partial(fit_batch, batch) for batch in batches), threads)) as computed,
    ):
        for batch, found in computed:
            batch.group.put(batch, found)
            report([picture for picture in batch.pictures if not picture.searched])
            if batch.last:
                yield batch.group.fits()


class _Looked(NamedTuple):
    """A picture that was read, looked through and cut.

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


class _Picture:
    """A picture that is read, looked through and cut by whichever thread first asks for it, and only once.

    Attributes:
        name: what it is called.
        searched: whether its faces are looked for.
    """

    def __init__(self, pipeline: Pipeline, source: Source):
        self.name, self.searched = source.name, source.boxes is None
        self._source, self._pipeline = source, pipeline
        self._looked: _Looked | None = None
        self._lock = Lock()

    def look(self) -> _Looked:
        """What is seen in it."""
        with self._lock:
            if self._looked is None:
                self._looked = _look(self._pipeline, self._source)
            return self._looked

    def __len__(self) -> int:
        """How many faces it has; where they are looked for, it takes the look."""
        return len(self.look().boxes if self._source.boxes is None else self._source.boxes)


class _Some(NamedTuple):
    """Some pictures of a group, and whether they are its last."""

    pictures: list[_Picture]
    last: bool


def _looking(pipeline: Pipeline, groups: Iterable[Sequence[Source]]) -> Iterator[Callable[[], _Some]]:
    """The work of looking through pictures, a few of one group at a time.

    Where all faces of a group are known, whoever fits them reads the pictures: to hand them over takes time.
    """

    def look_at(sources: Sequence[Source], last: bool) -> _Some:
        some = [_Picture(pipeline, source) for source in sources]
        for picture in some:
            if picture.searched:
                picture.look()
        return _Some(some, last)

    for group in groups:
        searched = any(source.boxes is None for source in group)
        together = _FOUND_TOGETHER if searched else max(1, len(group))
        for first in range(0, max(1, len(group)), together):
            yield partial(look_at, group[first : first + together], first + together >= len(group))


class Seen(NamedTuple):
    """A picture that was read and looked through.

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


def see(source: Source, detector: Detector | None, read: Read | None) -> Seen:
    """Read a picture, once, and find its faces unless they are known; arguments are those of `Pipeline`."""
    searching = detector if source.boxes is None else None
    boxes = np.empty((0, 4)) if source.boxes is None else source.boxes
    rotations = np.zeros(len(boxes)) if source.rotations is None else source.rotations
    unused = Seen(None, boxes, source.kinds, rotations)
    if source.boxes is not None and np.isnan(boxes).all():
        return unused._replace(why=NO_BOX)  # not read: nothing would be done with it
    if read is None:
        read = read_image if searching is not None and searching.colour else read_grey
    image = source.image
    try:
        picture = to_eight_bits(pixels(image, read))
        if searching is None:
            return unused._replace(picture=picture, why="" if len(boxes) else NO_BOX)
        picture = picture if searching.colour else to_grey(picture)
        found = searching(picture)
    except (ImageError, OSError) as error:
        why = str(error).removeprefix(f"{Path(image)}: ") if isinstance(image, str | Path) else str(error)
        return unused._replace(why=why)
    return Seen(
        picture,
        np.array([face.box for face in found], np.float64).reshape(-1, 4),
        tuple(face.kind for face in found),
        np.array([face.rotation for face in found]),
        "" if found else NO_FACE,
    )


def _look(pipeline: Pipeline, source: Source) -> _Looked:
    """Read a picture, find its faces unless they are known, and cut them."""
    with counted_together():
        picture, boxes, kinds, rotations, why = see(source, pipeline.detector, pipeline.read)
        if picture is None:
            return _Looked((0, 0), boxes, kinds, rotations, [why] * len(boxes), why)
        grey = to_grey(picture)
        faces = [_cut(pipeline.model, grey, *face) for face in zip(boxes, kinds, rotations, strict=True)]
    return _Looked((picture.shape[1], picture.shape[0]), boxes, kinds, rotations, faces, why)


def cut_source(pipeline: Pipeline, source: Source) -> Sequence[Crop | str]:
    """The crops of a picture that comes with boxes, or why there is none."""
    return _look(pipeline, source).faces


def _cut(model: Model, grey: np.ndarray, box: np.ndarray, kind: str, degrees: float) -> Crop | str:
    """The crop of the face in a box (4,), turned by so much, of a grey picture, uint8 (H, W); or why there is none."""
    if np.isnan(box).all():
        return NO_BOX
    if complaint := box_problem(box, grey.shape):
        return complaint
    rotation = math.radians(degrees)
    return cut_face(grey, *model.placement(kind).face_in(box, rotation), model.cascade.frame, rotation)


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
    model: Model, looked: Iterable[_Some], report: Callable[[Sequence[_Picture]], None]
) -> Generator[_Batch, None, None]:
    """Batches of the sizes that are compiled, large ones first; searched pictures are reported when they come.

    A group's faces are split as `batches_of` splits their number; large batches do not wait for the group's end.
    """
    group = _Group(model)
    large = batch_sizes()[0]
    enough = several = large * _least(large)  # waiting faces from which large batches are used
    for some in looked:
        for picture in some.pictures:
            group.add(picture)
            while group.waiting >= enough:
                enough = large
                yield group.take(large)
        report([picture for picture in some.pictures if picture.searched])
        if some.last:
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
        """The next batch, of so many faces; the last has the pictures behind them, too."""
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
            looked, number, first = picture.look(), len(self._names), len(self._pictures)
            self._names.append(picture.name)
            self._sizes.append(looked.size)
            self._boxes.append(looked.boxes)
            self._kinds += looked.kinds
            self._rotations.append(looked.rotations)
            self._pictures += [number] * len(looked.boxes)
            if not len(looked.boxes):
                self._problems.append(Problem(number, picture.name, looked.why))
            for row, face in enumerate(looked.faces, first):
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
    return shapes if model.confidence is None else shapes | {"confidence": ()}


def in_pictures(crops: Crops, found: _Found) -> _Found:
    """What was found in crops, in the pixels of the pictures, float64."""
    found = {name: values.astype(np.float64) for name, values in found.items()}
    found["landmarks"] = crops.to_images(found["landmarks"])
    if "landmarks_3d" in found:
        flat = crops.to_images(found["landmarks_3d"][..., :2])
        depths = found["landmarks_3d"][..., 2:] * crops.scale[:, None, None]
        found |= {"landmarks_3d": np.concatenate([flat, depths], -1), "scale": found["scale"] * crops.scale}
        found["pose"] = turned_poses(found["pose"], np.degrees(crops.rotation))
    return found


def batch_sizes() -> tuple[int, ...]:
    """Sizes of batches, large ones first."""
    several = len(jax.local_devices())
    return BATCHES if several == 1 else (several * BATCHES[0], *BATCHES)


def batches_of(count: int) -> list[int]:
    """The sizes of the batches in which ``count`` faces are fitted, large ones first.

    Several batches are computed at once: a single device takes large ones only where there is one for every thread.
    """
    least = _least(count)
    sizes: list[int] = []
    for size in batch_sizes():
        if size == 1 or count // size >= least:
            sizes += [size] * (count // size)
            count %= size
    return sizes


def _least(count: int) -> int:
    """How many batches of a size there must be among ``count`` faces for it to be used."""
    return reading_threads(count) if len(jax.local_devices()) == 1 else 1


def computed_at_once() -> int:
    """How many batches are computed at the same time.

    Much of a computation keeps to one core, so that each core has its own; an accelerator computes one while the next
    is on its way to it. Batches that are shared out to several devices keep all of them busy.
    """
    if len(jax.local_devices()) > 1:
        return 1
    return min(_MOST_AT_ONCE, cores()) if jax.default_backend() == "cpu" else 2


def _computing(pipeline: Pipeline) -> Callable[[np.ndarray], dict[str, jax.Array]]:
    """What finds, in crops (N, side, side), all that is in `Fits`, by name, in crop pixels; it works in the background.

    Batches that are larger than one device's are shared out to all devices, and the model with them.
    """
    model, rotations, passes = pipeline.model, pipeline.starts.rotations, pipeline.passes
    parts = model.cascade, model.aligned, model.confidence

    @cache  # which takes time and memory: only where there is such a batch
    def everywhere() -> Any:
        return jax.device_put(parts, NamedSharding(_mesh(), PartitionSpec()))

    def compute(crops: np.ndarray) -> dict[str, jax.Array]:
        if len(crops) <= BATCHES[0]:
            return _find(*parts, crops, rotations, passes, None)
        shared = jax.device_put(crops, NamedSharding(_mesh(), PartitionSpec("faces")))
        return _find(*everywhere(), shared, rotations, passes, _mesh())

    return compute


def _mesh() -> Mesh:
    """This process's devices."""
    devices = jax.local_devices()
    return jax.make_mesh((len(devices),), ("faces",), (AxisType.Auto,), devices=devices)


@partial(jax.jit, static_argnames=("passes", "mesh"))
def _find(
    cascade: Cascade,
    aligned: ShapeSpace3D | None,
    confidence: Confidence | None,
    crops: jax.Array,
    rotations: jax.Array,
    passes: int,
    mesh: Mesh | None,
) -> dict[str, jax.Array]:
    """What is found in crops; by each device of the mesh in its share of them."""

    def of_share(
        cascade: Cascade,
        aligned: ShapeSpace3D | None,
        confidence: Confidence | None,
        rotations: jax.Array,
        crops: jax.Array,
    ) -> dict:
        return find(cascade, aligned, crops, rotations, passes, confidence)

    if mesh is not None:
        everything, faces = PartitionSpec(), PartitionSpec("faces")
        of_share = jax.shard_map(
            of_share,
            mesh=mesh,
            in_specs=(everything, everything, everything, everything, faces),
            out_specs=faces,
            check_vma=False,  # loops begin with constants, which all devices share
        )
    return of_share(cascade, aligned, confidence, rotations, crops)


@computing
def compile_batches(pipeline: Pipeline, sizes: Sequence[int]) -> None:
    """Compile what fits batches of these sizes."""
    compute, side = _computing(pipeline), pipeline.model.cascade.frame.crop
    for size in sizes:
        jax.block_until_ready(compute(np.zeros((size, side, side), np.uint8)))
