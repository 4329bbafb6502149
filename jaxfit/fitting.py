"""Fitting pictures: crops through the cascade in fixed-size batches, landmarks back to the pictures."""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from numpy.typing import ArrayLike

from jaxfit.cascade.fit import ANY_ROTATION, find, start_rotations
from jaxfit.cascade.model import Cascade
from jaxfit.cropping import CutFace, Images, Read, cores, cut_faces
from jaxfit.data.crops import to_image
from jaxfit.data.images import read_upright
from jaxfit.exceptions import InputError
from jaxfit.models.model import SQUARE, Model
from jaxfit.shapes.camera_asm import CameraASM

# Every number of faces is served by batches of these sizes: three compilations, whatever comes. Where there are several
# devices, one more: batches of the first size for each of them, all at once.
BATCHES = (64, 8, 1)
_MOST_AT_ONCE = 8  # each holds a batch and its descriptors


_Found = dict[str, np.ndarray]


@dataclass(frozen=True)
class Fits:
    """Fits of N faces.

    Attributes:
        landmarks: (N, L, 2) float64, x right, y down, in the pixels of each picture; NaN for faces not fitted.
        problems: for each face that was not fitted, its number and why.
        landmarks_3d: (N, L, 3) the 3D shape in the pixels of each picture: x, y, and the depth away from the viewer,
            0 at the mean face's centroid. None, like all below, for models without 3D.
        pose: (N, 3) roll, pitch and yaw in degrees: clockwise as seen, looking up, nose to the image's left.
        scale: (N,) s of Eq. 15, pixels of the picture per pixel of the canonical face.
        b: (N, M) coefficients of the 3D shape model, ``model.solid.model``.
    """

    landmarks: np.ndarray
    problems: dict[int, str]
    landmarks_3d: np.ndarray | None = None
    pose: np.ndarray | None = None
    scale: np.ndarray | None = None
    b: np.ndarray | None = None

    @property
    def ok(self) -> np.ndarray:
        """(N,) bool: which faces were fitted."""
        return np.isfinite(self.landmarks).all((1, 2))

    def __len__(self) -> int:
        return len(self.landmarks)


def fit(
    model: Model,
    images: Images,
    boxes: ArrayLike,
    *,
    kind: str | Sequence[str] = SQUARE,
    initialisations: int = 1,
    rotations: tuple[float, float] = ANY_ROTATION,
    refine: bool = False,
    read: Read = read_upright,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Fits:
    """Find the landmarks of N faces, and their 3D shapes and poses if the model knows of them.

    A picture or box that cannot be used does not stop the others: its landmarks are NaN and ``problems`` says why.

    Args:
        model: from ``jaxfit.load``.
        images: N pictures: their files, which are read while others are fitted, or uint8 arrays of any sizes, (H, W)
            grey, (H, W, 3) RGB or (H, W, 4) RGBA; for several faces in one picture give the same several times.
        boxes: (N, 4) x, y, width, height of the faces, in pixels.
        kind: what drew the boxes: ``"square"`` are squares around the landmarks, give or take; the others that a model
            knows stand in ``model.placements``. One for all, or N of them.
        initialisations: starts for each face, one or at least three, turned evenly over ``rotations``; the fit nearest
            to all others is kept (thesis 3.2.3). Worth their time, a multiple of one start's, where faces may be
            turned in the picture and the model was trained for it.
        rotations: lowest and highest rotation of the starts, in degrees, clockwise as seen; a single start is in the
            middle.
        refine: for models of 3D alignment, adjust shape and camera together after it; slow.
        read: makes an array of a file, in threads; unless told, pictures are turned upright as their EXIF data say.
        progress: called with the stage's name, faces done and faces in all.

    Raises:
        InputError: ``boxes`` is not (N, 4), ``kind`` is unknown, there are no initialisations or no range, or nothing
            to refine.
    """
    turns = start_rotations(initialisations, rotations)
    require_refinable(model, refine)
    (fits,) = _fits(model, cut_faces(model, images, boxes, kind, read), len(images), _Way(turns, refine), progress)
    return fits


def fit_steps(
    model: Model,
    images: Images,
    boxes: ArrayLike,
    *,
    kind: str | Sequence[str] = SQUARE,
    read: Read = read_upright,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> list[Fits]:
    """The fits after each step of the cascade, from one start a face; the last are those of `fit`.

    Args:
        model: as in `fit`, like all below.
        images: N pictures.
        boxes: (N, 4), in pixels.
        kind: what drew the boxes.
        read: makes an array of a file.
        progress: called with the stage's name, faces done and faces in all.

    Raises:
        InputError: as `fit`.
    """
    faces = cut_faces(model, images, boxes, kind, read)
    return _fits(model, faces, len(images), _Way(every_step=True), progress)


class _Way(NamedTuple):
    """How crops are fitted: from these rotations, with refined alignments, and telling the fits after every step."""

    turns: jax.Array | None = None
    refine: bool = False
    every_step: bool = False


def _fits(
    model: Model,
    faces: Generator[CutFace, None, None],
    count: int,
    way: _Way,
    progress: Callable[[str, int, int], None],
) -> list[Fits]:
    """The fits of ``count`` faces: of the whole cascade, or after each step."""
    steps = len(model.cascade.windows) if way.every_step else 1
    fits = [Fits(problems={}, **_empty(model, count)) for _ in range(steps)]
    problems: dict[int, str] = {}
    compute = _computing(model, way, count)
    device: Any = getattr(jax.config, "jax_default_device")  # noqa: B009 - not in its stubs; threads do not know it
    at_once = computed_at_once()
    computing: deque[tuple[list[CutFace], Future[_Found]]] = deque()

    def computed(crops: np.ndarray) -> _Found:
        with jax.default_device(device):
            return {name: np.asarray(of) for name, of in compute(crops).items()}

    def keep() -> None:
        """Wait for the batch that is computed first, and put what is found where it belongs."""
        batch, waited = computing.popleft()
        found = _in_pictures(batch, waited.result())
        for step, each in enumerate(fits):
            _put(each, batch, {name: of[:, step] for name, of in found.items()} if way.every_step else found)

    with closing(faces), ThreadPoolExecutor(at_once) as pool:
        for batch in _batches(faces, problems):  # whose crops are cut while batches before are computed
            if len(computing) == at_once:
                keep()
            progress("fitting", batch[0].number, count)
            crops = np.stack([face.crop.pixels for face in batch if face.crop])
            computing.append((batch, _done(computed, crops) if count == 1 else pool.submit(computed, crops)))
        while computing:
            keep()
    progress("fitting", count, count)
    return [replace(each, problems=dict(sorted((problems | each.problems).items()))) for each in fits]


def _done(work: Callable[[np.ndarray], _Found], crops: np.ndarray) -> Future[_Found]:
    """As if a thread had done it; for a single face it would take as long again to wake one."""
    future: Future[_Found] = Future()
    future.set_result(work(crops))
    return future


def _batches(faces: Iterator[CutFace], problems: dict[int, str]) -> Iterator[list[CutFace]]:
    """Faces with crops in batches of few sizes; why others have none is put among the problems."""
    sizes = batch_sizes()
    batch: list[CutFace] = []
    for face in faces:
        if face.crop is None:
            problems[face.number] = face.problem
            continue
        batch.append(face)
        if len(batch) == sizes[0]:
            yield batch
            batch = []
    for size in sizes[1:]:
        while len(batch) >= size:
            yield batch[:size]
            batch = batch[size:]


def _in_pictures(batch: Sequence[CutFace], found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What was found in the crops of a batch, in the pixels of the pictures."""
    crops = [face.crop for face in batch if face.crop]
    scale, offset = np.array([crop.scale for crop in crops]), np.stack([crop.offset for crop in crops])

    def points(values: np.ndarray) -> np.ndarray:
        between = (1,) * (values.ndim - 2)  # steps, if there are any, and landmarks
        return to_image(values, scale.reshape(-1, *between, 1), offset.reshape(-1, *between, 2))

    found = {name: values.astype(np.float64) for name, values in found.items()}
    found["landmarks"] = points(found["landmarks"])
    if "landmarks_3d" in found:
        depths = found["landmarks_3d"][..., 2:] * scale.reshape(-1, *(1,) * (found["landmarks_3d"].ndim - 1))
        found["landmarks_3d"] = np.concatenate([points(found["landmarks_3d"][..., :2]), depths], -1)
        found["scale"] *= scale.reshape(-1, *(1,) * (found["scale"].ndim - 1))
    return found


def _put(fits: Fits, batch: Sequence[CutFace], found: dict[str, np.ndarray]) -> None:
    """Put what was found in a batch among the fits; of faces that diverged, that they did."""
    finite = np.all([np.isfinite(values.reshape(len(batch), -1)).all(1) for values in found.values()], 0)
    numbers = np.array([face.number for face in batch])
    for name, values in found.items():
        getattr(fits, name)[numbers[finite]] = values[finite]
    for row in map(int, np.flatnonzero(~finite)):
        fits.problems[batch[row].number] = f"{batch[row].source}the fit diverged"


def require_refinable(model: Model, refine: bool) -> None:
    """Check that a model aligns a 3D shape, if that is to be refined.

    Raises:
        InputError: it does not.
    """
    if refine and model.head is None:
        raise InputError("refine: only models of the method alignment3d align a 3D shape that could be refined")


def _empty(model: Model, count: int) -> dict[str, np.ndarray]:
    """What is found of ``count`` faces, by its name in `Fits`; NaN."""
    shapes: dict[str, tuple[int, ...]] = {"landmarks": (model.scheme.count, 2)}
    if model.solid is not None:
        modes = len(model.solid.model.deviations)
        shapes |= {"landmarks_3d": (model.scheme.count, 3), "pose": (3,), "scale": (), "b": (modes,)}
    return {name: np.full((count, *shape), np.nan) for name, shape in shapes.items()}


def batch_sizes() -> tuple[int, ...]:
    """Sizes of batches, large ones first."""
    several = len(jax.local_devices())
    return BATCHES if several == 1 else (several * BATCHES[0], *BATCHES)


def computed_at_once() -> int:
    """How many batches are computed at the same time.

    Much of a computation keeps to one core, so that each core has its own; an accelerator computes one while the next
    is on its way to it. Batches that are shared out to several devices keep all of them busy.
    """
    if len(jax.local_devices()) > 1:
        return 1
    return min(_MOST_AT_ONCE, cores()) if jax.default_backend() == "cpu" else 2


def _mesh() -> Mesh:
    """This process's devices."""
    devices = jax.local_devices()
    return jax.make_mesh((len(devices),), ("faces",), (AxisType.Auto,), devices=devices)


def _computing(model: Model, way: _Way, count: int) -> Callable[[np.ndarray], dict[str, jax.Array]]:
    """What finds, in crops (N, side, side), all that is in `Fits`, by name, in crop pixels; it works in the background.

    Batches that are larger than one device's are shared out to all devices, and the model with them: if there will be
    such a batch among ``count`` faces.
    """
    parts = model.cascade, model.head
    if len(jax.local_devices()) == 1 or count < batch_sizes()[0]:
        return lambda crops: _found(*parts, crops, *way, None)
    mesh = _mesh()
    everywhere = jax.device_put(parts, NamedSharding(mesh, PartitionSpec()))
    of_each = NamedSharding(mesh, PartitionSpec("faces"))

    def compute(crops: np.ndarray) -> dict[str, jax.Array]:
        if len(crops) > BATCHES[0]:
            return _found(*everywhere, jax.device_put(crops, of_each), *way, mesh)
        return _found(*parts, crops, *way, None)

    return compute


@partial(jax.jit, static_argnames=("refine", "every_step", "mesh"))
def _found(
    cascade: Cascade,
    head: CameraASM | None,
    crops: jax.Array,
    turns: jax.Array | None,
    refine: bool,
    every_step: bool,
    mesh: Mesh | None,
) -> dict[str, jax.Array]:
    """What is found in crops; by each device of the mesh in its share of them."""

    def of_share(cascade: Cascade, head: CameraASM | None, turns: jax.Array | None, crops: jax.Array) -> dict:
        return find(cascade, head, crops, turns, refine, every_step)

    if mesh is not None:
        everything, faces = PartitionSpec(), PartitionSpec("faces")
        of_share = jax.shard_map(
            of_share,
            mesh=mesh,
            in_specs=(everything, everything, everything, faces),
            out_specs=faces,
            check_vma=False,  # loops begin with constants, which all devices share
        )
    return of_share(cascade, head, turns, crops)


def warm_up(
    model: Model,
    batches: Sequence[int] | None = None,
    initialisations: int = 1,
    refine: bool = False,
    every_step: bool = False,
) -> None:
    """Compile the model for the batch sizes that ``fit`` uses, all unless told; the first fit is then as fast as the
    others.

    With ``every_step`` it is for `fitting.fit_steps`, which has a single start whatever ``initialisations`` says.

    Raises:
        InputError: no initialisations, or two, or nothing to refine.
    """
    require_refinable(model, refine)
    side = model.cascade.frame.crop
    turns = None if every_step else start_rotations(initialisations, ANY_ROTATION)
    sizes = batch_sizes() if batches is None else batches
    compute = _computing(model, _Way(turns, refine, every_step), max(sizes, default=0))
    for size in sizes:
        jax.block_until_ready(compute(np.zeros((size, side, side), np.uint8)))
