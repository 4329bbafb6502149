"""The one way from pictures to fits: read, find faces, cut crops, fit batches.

    groups of pictures -> read (once) -> find faces -> cut -> batches of crops -> Fits of each group

Every call, command and worker that fits goes through here. Threads read and look through pictures, others compute
batches, and what they give comes back in order. A few pictures and batches are in memory at a time, however many there
are.
"""

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jaxfit.cascade.confidence import Confidence
from jaxfit.cascade.fit import find
from jaxfit.cascade.model import Cascade
from jaxfit.cascade.starts import Starts
from jaxfit.data.boxes import box_problem
from jaxfit.data.crops import Crops, cut
from jaxfit.data.detectors import Detector
from jaxfit.data.pictures import Image, Read, pixels, read_image, read_upright, to_eight_bits, to_grey
from jaxfit.data.threads import cores, in_order, reading_threads
from jaxfit.errors import ImageError, InputError
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.image.frame import Frame
from jaxfit.models.model import Model
from jaxfit.shapes.pose_order import turned_poses
from jaxfit.shapes.space import ShapeSpace3D

# Any number of faces is served by batches of these sizes, so that there are three compilations. Where there are several
# devices there is one more: batches of the first size for each of them, all at once.
BATCHES = (64, 8, 1)
NO_FACE = "no face found; give face boxes, or take another detector"  # the problem of a picture without one
NO_BOX = "there is no face box"
_MOST_AT_ONCE = 8  # batches that are computed at once; each holds a batch and its descriptors
_FOUND_TOGETHER, _CUT_TOGETHER = 4, 16  # pictures that a thread looks through, or cuts, before it hands them on

Progress = Callable[[str, int, int], None]
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


@dataclass(frozen=True)
class Pipeline:
    """How pictures are fitted.

    Attributes:
        model: from ``jaxfit.load``.
        detector: finds the faces of pictures that come without boxes; None where all have them.
        starts: of each face.
        passes: how often the cascade is run, each time from where the pass before found the face.
        read: makes an array of a picture's file, or of its bytes; None turns pictures upright as their EXIF data say,
            and reads colours only if the detector looks at them.

    Raises:
        InputError: no passes, or a detector whose boxes the model does not know.
    """

    model: Model
    detector: Detector | None = None
    starts: Starts = field(default_factory=Starts)
    passes: int = 1
    read: Read | None = None

    def __post_init__(self) -> None:
        if self.passes < 1:
            raise InputError(f"expected at least one pass of the cascade; got {self.passes}")
        for kind in () if self.detector is None else self.detector.kinds:
            self.model.placement(kind)


def stream(
    pipeline: Pipeline,
    groups: Iterable[Sequence[Source]],
    pictures: int,
    progress: Progress = lambda stage, done, total: None,
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
    threads = reading_threads(pictures)
    compute = _computing(pipeline)
    device: Any = getattr(jax.config, "jax_default_device")  # noqa: B009 - not in its stubs; threads do not know it

    def fit_batch(batch: _Batch) -> tuple[_Batch, _Found]:
        if not len(batch.rows):
            return batch, {}
        with jax.default_device(device):
            found = compute(batch.crops.pixels)
            return batch, {name: np.asarray(values) for name, values in found.items()}

    progress("fitting", 0, pictures)
    with (
        closing(in_order(_looking(pipeline, groups), threads)) as looked,
        closing(_batches(pipeline.model, looked, pictures, progress)) as batches,
        closing(in_order((partial(fit_batch, batch) for batch in batches), computed_at_once())) as computed,
    ):
        for batch, found in computed:
            batch.group.put(batch, found)
            if batch.last:
                yield batch.group.fits()


class _Looked(NamedTuple):
    """A picture that was read, looked through and cut.

    Attributes:
        name: what it is called.
        size: its width and height; zeros if it could not be read.
        boxes: (n, 4) of its faces.
        kinds: what drew them.
        rotations: (n,) how far each face is turned, in degrees.
        crops: one a face; black where it could not be cut.
        problems: why a face could not be cut, by its number.
        why: why there is no face in the picture; empty if there are some.
    """

    name: str
    size: tuple[int, int]
    boxes: np.ndarray
    kinds: tuple[str, ...]
    rotations: np.ndarray
    crops: Crops
    problems: dict[int, str]
    why: str = ""


class _LookedSome(NamedTuple):
    """Some pictures of a group, and whether they are its last."""

    pictures: list[_Looked]
    last: bool


def _looking(pipeline: Pipeline, groups: Iterable[Sequence[Source]]) -> Iterator[Callable[[], _LookedSome]]:
    """The work of looking through pictures, a few of one group at a time."""

    def look_at(sources: Sequence[Source], last: bool) -> _LookedSome:
        return _LookedSome([_look(pipeline, source) for source in sources], last)

    for group in groups:
        searched = any(source.boxes is None for source in group)
        together = _FOUND_TOGETHER if searched else _CUT_TOGETHER
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
        read = read_image if searching is not None and searching.colour else read_upright
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
    picture, boxes, kinds, rotations, why = see(source, pipeline.detector, pipeline.read)
    if picture is None:
        crops = Crops.empty(len(boxes), pipeline.model.cascade.frame)
        unread = dict.fromkeys(range(len(boxes)), why)
        return _Looked(source.name, (0, 0), boxes, kinds, rotations, crops, unread, why)
    crops, problems = _cut_faces(pipeline.model, to_grey(picture), boxes, kinds, rotations)
    size = (picture.shape[1], picture.shape[0])
    return _Looked(source.name, size, boxes, kinds, rotations, crops, problems, why)


def cut_source(pipeline: Pipeline, source: Source) -> tuple[Crops, dict[int, str]]:
    """The crops of a picture that comes with boxes; black, with a reason by the face's number, where there is none."""
    looked = _look(pipeline, source)
    return looked.crops, looked.problems


def _cut_faces(
    model: Model, grey: np.ndarray, boxes: np.ndarray, kinds: Sequence[str], rotations: np.ndarray
) -> tuple[Crops, dict[int, str]]:
    """The crops (n) of the faces in boxes (n, 4) of a grey picture, uint8 (H, W), turned by rotations (n,) in degrees;
    black, with a reason by the face's number, where there is nothing to cut."""
    crops = Crops.empty(len(boxes), model.cascade.frame)
    problems: dict[int, str] = {}
    for row, (box, kind, rotation) in enumerate(zip(boxes, kinds, np.radians(rotations).tolist(), strict=True)):
        if np.isnan(box).all():
            problems[row] = NO_BOX
        elif complaint := box_problem(box, grey.shape):
            problems[row] = complaint
        else:
            cut(grey, *model.placement(kind).face_in(box, rotation), crops, row, rotation)
    return crops, problems


class _Batch(NamedTuple):
    """Crops of some faces of a group.

    Attributes:
        group: whose faces.
        rows: of the faces among the group's.
        crops: of these faces.
        last: whether they are the group's last.
    """

    group: "_Group"
    rows: np.ndarray
    crops: Crops
    last: bool


def _batches(
    model: Model, looked: Iterable[_LookedSome], pictures: int, progress: Progress
) -> Generator[_Batch, None, None]:
    """The crops of looked-through pictures, in batches of the sizes that are compiled, large ones first.

    A group's crops are split as `batches_of` splits their number; large batches do not wait for the group's end.
    """
    group, waiting, done = _Group(model), _Waiting(model.cascade.frame), 0
    large = batch_sizes()[0]
    enough = several = large * _least(large)  # waiting crops from which large batches are used
    for some in looked:
        for picture in some.pictures:
            waiting.add(*group.add(picture))
        done += len(some.pictures)
        progress("fitting", done, pictures)
        while len(waiting) >= enough:
            enough = large
            yield _Batch(group, *waiting.take(large), last=False)
        if some.last:
            sizes = batches_of(len(waiting)) or [0]
            for number, size in enumerate(sizes, 1):
                yield _Batch(group, *waiting.take(size), last=number == len(sizes))
            group, enough = _Group(model), several


class _Waiting:
    """Crops that wait for a batch."""

    def __init__(self, frame: Frame):
        self._rows = np.empty(0, int)
        self._crops = [Crops.empty(0, frame)]

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, rows: np.ndarray, crops: Crops) -> None:
        """Crops of faces with these numbers."""
        self._rows = np.concatenate([self._rows, rows])
        self._crops.append(crops)

    def take(self, count: int) -> tuple[np.ndarray, Crops]:
        """The first so many: their numbers and crops."""
        rows, self._rows = np.split(self._rows, [count])
        crops = Crops.join(self._crops)
        self._crops = [crops[count:]]
        return rows, crops[:count]


class _Group:
    """What is known of a group's pictures and faces, filled in as it comes."""

    def __init__(self, model: Model):
        self._model = model
        self._names: list[str] = []
        self._sizes: list[tuple[int, int]] = []
        self._boxes: list[np.ndarray] = [np.empty((0, 4))]
        self._kinds: list[str] = []
        self._rotations: list[np.ndarray] = [np.empty(0)]
        self._pictures: list[int] = []
        self._problems: list[Problem] = []
        self._found: list[tuple[np.ndarray, _Found]] = []

    def add(self, picture: _Looked) -> tuple[np.ndarray, Crops]:
        """A looked-through picture; returns the numbers and crops of its faces that can be fitted."""
        number, first, count = len(self._names), len(self._pictures), len(picture.boxes)
        self._names.append(picture.name)
        self._sizes.append(picture.size)
        self._boxes.append(picture.boxes)
        self._kinds += picture.kinds
        self._rotations.append(picture.rotations)
        self._pictures += [number] * count
        if not count:
            self._problems.append(Problem(number, picture.name, picture.why))
        for row, why in picture.problems.items():
            self._problems.append(Problem(number, picture.name, why, first + row))
        whole = np.array([row for row in range(count) if row not in picture.problems], int)
        return first + whole, picture.crops if len(whole) == count else picture.crops[whole]

    def put(self, batch: _Batch, found: _Found) -> None:
        """What was found in a batch."""
        if found:
            self._found.append((batch.rows, in_pictures(batch.crops, found)))

    def fits(self) -> Fits:
        """The fits, when all batches have come."""
        count = len(self._pictures)
        arrays = {name: np.full((count, *shape), np.nan) for name, shape in _shapes(self._model).items()}
        for rows, found in self._found:
            for name, values in found.items():
                arrays[name][rows] = values
        finite = np.all([np.isfinite(values).all((*range(1, values.ndim),)) for values in arrays.values()], 0)
        for values in arrays.values():
            values[~finite] = np.nan
        known = {problem.row for problem in self._problems}
        diverged = [row for row in map(int, np.flatnonzero(~finite)) if row not in known]
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


def compile_batches(pipeline: Pipeline, sizes: Sequence[int]) -> None:
    """Compile what fits batches of these sizes."""
    compute, side = _computing(pipeline), pipeline.model.cascade.frame.crop
    for size in sizes:
        jax.block_until_ready(compute(np.zeros((size, side, side), np.uint8)))
