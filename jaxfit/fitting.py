"""Fitting pictures: crops through the cascade in fixed-size batches, landmarks back to the pictures."""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from threading import Semaphore
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from numpy.typing import ArrayLike

from jaxfit.cascade.confidence import Confidence
from jaxfit.cascade.fit import ANY_ROTATION, find, start_rotations
from jaxfit.cascade.model import Cascade
from jaxfit.cropping import (
    CutFaces,
    Faces,
    Image,
    Images,
    Read,
    cores,
    cutting,
    faces_to_cut,
    in_order,
    reading_threads,
)
from jaxfit.data.crops import Crops, to_image
from jaxfit.data.detectors import DEFAULT_DETECTOR, Detector, detector_named
from jaxfit.data.images import read_image, read_upright
from jaxfit.detecting import Found, find_faces
from jaxfit.exceptions import InputError
from jaxfit.models.model import SQUARE, Model
from jaxfit.shapes.camera_asm import CameraASM

# Every number of faces is served by batches of these sizes: three compilations, whatever comes. Where there are several
# devices, one more: batches of the first size for each of them, all at once.
BATCHES = (64, 8, 1)
_MOST_AT_ONCE = 8  # each holds a batch and its descriptors


_Arrays = dict[str, np.ndarray]  # what is found in a batch, by its name in `Fits`


@dataclass(frozen=True)
class Fits:
    """Fits of N faces.

    Attributes:
        landmarks: (N, L, 2) float64, x right, y down, in the pixels of each picture; NaN for faces not fitted.
        problems: for each face that was not fitted, its number and why.
        pictures: (N,) the number of each face's picture among those given.
        boxes: (N, 4) x, y, width, height of the boxes that the fits started from, in pixels; NaN where there was none.
        kinds: what drew each box.
        landmarks_3d: (N, L, 3) the 3D shape in the pixels of each picture: x, y, and the depth away from the viewer,
            0 at the mean face's centroid. None, like all below, for models without 3D.
        pose: (N, 3) roll, pitch and yaw in degrees: clockwise as seen, looking up, nose to the image's left.
        scale: (N,) s of Eq. 15, pixels of the picture per pixel of the canonical face.
        b: (N, M) coefficients of the 3D shape model, ``model.solid.model``.
        confidence: (N,) the probability, in [0, 1], that the fit is a good one, as ``jaxfit.learn_confidence`` says;
            NaN for faces not fitted, None for models that do not know it and for fits after every step.
    """

    landmarks: np.ndarray
    problems: dict[int, str]
    pictures: np.ndarray
    boxes: np.ndarray
    kinds: tuple[str, ...]
    landmarks_3d: np.ndarray | None = None
    pose: np.ndarray | None = None
    scale: np.ndarray | None = None
    b: np.ndarray | None = None
    confidence: np.ndarray | None = None

    @property
    def fitted(self) -> np.ndarray:
        """(N,) bool: which faces were fitted, well or not."""
        return np.isfinite(self.landmarks).all((1, 2))

    @property
    def ok(self) -> np.ndarray:
        """(N,) bool: which faces were fitted, and rather well than not if the model has a confidence in its fits."""
        return self.fitted if self.confidence is None else self.fitted & (self.confidence >= 0.5)

    def __len__(self) -> int:
        return len(self.landmarks)


def fit(
    model: Model,
    images: Images,
    boxes: ArrayLike | None = None,
    *,
    kind: str | Sequence[str] | None = None,
    detector: str | Detector | None = None,
    initialisations: int = 1,
    rotations: tuple[float, float] = ANY_ROTATION,
    refine: bool = False,
    passes: int | None = None,
    read: Read | None = None,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Fits:
    """Find the landmarks of faces, and their 3D shapes and poses if the model knows of them.

    With boxes, N of them for N pictures, a face a picture; without, the faces are looked for, and all that are found in
    a picture are fitted: ``pictures`` says whose they are. A picture or box that cannot be used, or a picture without a
    face, does not stop the others: there is a face with landmarks of NaN for it, and ``problems`` says why.

    Several faces are computed in threads, which take JAX's default device from the caller, but nothing else that
    context managers of JAX set.

    Args:
        model: from ``jaxfit.load``.
        images: pictures: their files, which are read while others are fitted, the bytes of such files, or uint8 arrays
            of any sizes, (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA; for boxes of several faces in one picture give
            it several times.
        boxes: (N, 4) x, y, width, height of the faces, in pixels; None finds them.
        kind: what drew the boxes: ``"square"``, the default, are squares around the landmarks, give or take; the others
            that a model knows stand in ``model.placements``. One for all, or N of them.
        detector: what finds the faces if there are no boxes: as in ``jaxfit.detect_faces``, and by default ``"haar"``.
        initialisations: starts for each face, one or at least three, turned evenly over ``rotations``; the fit nearest
            to all others is kept (thesis 3.2.3). Worth their time, a multiple of one start's, where faces may be
            turned in the picture and the model was trained for it.
        rotations: lowest and highest rotation of the starts, in degrees, clockwise as seen; a single start is in the
            middle.
        refine: for models of 3D alignment, adjust shape and camera together after it; slow.
        passes: how often the cascade is run, each time from where the pass before found the face: more than once makes
            up for rough boxes. By default once from given boxes, and as suits the detector from found ones.
        read: makes an array of a file, or of its bytes, in threads; unless told, pictures are turned upright as their
            EXIF data say.
        progress: called with the stage's name, what is done and what there is to do.

    Raises:
        InputError: ``boxes`` is not (N, 4), ``kind`` or ``detector`` is unknown or not asked for, there are no
            initialisations, no range or no passes, or nothing to refine.
    """
    turns = start_rotations(initialisations, rotations)
    require_refinable(model, refine)
    if passes is not None and passes < 1:
        raise InputError(f"expected at least one pass of the cascade; got {passes}")
    if boxes is not None:
        if detector is not None:
            raise InputError("expected boxes or a detector that finds them; got both")
        faces = faces_to_cut(model, images, boxes, kind or SQUARE, read or read_upright)
        (fits,) = _fits(model, faces, _Way(turns, refine, passes=passes or 1), progress)
        return fits
    if kind is not None:
        raise InputError(
            f"expected boxes of the kind {kind!r}; without boxes, the detector says of what kind its own are"
        )
    find = detector_named(detector or DEFAULT_DETECTOR) if isinstance(detector, str | None) else detector
    for each in find.kinds:
        model.placement(each)
    found = find_faces(images, find, read=read or read_image, progress=progress)
    way = _Way(turns, refine, passes=passes or passes_from(find))
    return _fits_of_found(model, found, images, read or read_upright, way, progress)


def passes_from(detector: Detector) -> int:
    """How often the cascade is run from the boxes of a detector, unless told otherwise."""
    return 2 if detector.rough else 1


def _fits_of_found(
    model: Model,
    found: Found,
    images: Images,
    read: Read,
    way: "_Way",
    progress: Callable[[str, int, int], None],
) -> Fits:
    """The fits of found faces, in the order of the pictures; NaN for pictures without any."""
    missed = np.array(sorted(found.problems), int)
    pictures = np.concatenate([found.pictures, missed])
    boxes = np.concatenate([found.boxes, np.full((len(missed), 4), np.nan)])
    kinds = [*found.kinds, *[SQUARE] * len(missed)]
    order = np.argsort(pictures, kind="stable")
    chosen = _Chosen(images, pictures[order])
    faces = faces_to_cut(model, chosen, boxes[order], [kinds[number] for number in order], read)
    (fits,) = _fits(model, faces, way, progress)
    why = {
        row: found.problems[int(pictures[number])] for row, number in enumerate(order) if number >= len(found.pictures)
    }
    return replace(fits, pictures=pictures[order], problems=fits.problems | why)


class _Chosen(Sequence[Image]):
    """Some of a sequence's pictures, which are taken from it when they are asked for."""

    def __init__(self, images: Images, numbers: np.ndarray):
        self._images, self._numbers = images, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: Any) -> Any:
        return self._images[self._numbers[index]]


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
    return _fits(model, faces_to_cut(model, images, boxes, kind, read), _Way(every_step=True), progress)


class _Way(NamedTuple):
    """How crops are fitted: from these rotations, with refined alignments, telling the fits after every step, and in so
    many passes."""

    turns: jax.Array | None = None
    refine: bool = False
    every_step: bool = False
    passes: int = 1


def _fits(
    model: Model,
    faces: Faces,
    way: _Way,
    progress: Callable[[str, int, int], None],
) -> list[Fits]:
    """The fits of the whole cascade, or after each step."""
    count = len(faces)
    steps = len(model.cascade.windows) if way.every_step else 1
    fits = [_unfitted(model, faces, way) for _ in range(steps)]
    compute = _computing(model, way, count)
    device: Any = getattr(jax.config, "jax_default_device")  # noqa: B009 - not in its stubs; threads do not know it
    free = Semaphore(computed_at_once())

    def fit_batch(cut: Callable[[], CutFaces]) -> tuple[CutFaces, _Arrays]:
        batch = cut()
        if len(batch.problems) == len(batch.numbers):
            return batch, {}
        with free, jax.default_device(device):
            return batch, {name: np.asarray(of) for name, of in compute(batch.crops.pixels).items()}

    batches = (partial(fit_batch, part) for part in cutting(faces, batches_of(count)))
    progress("fitting", 0, count)
    with closing(in_order(batches, reading_threads(count))) as fitted:
        for batch, in_crops in fitted:
            found = _in_pictures(batch.crops, in_crops)
            for step, each in enumerate(fits):
                _put(each, batch, {name: of[:, step] for name, of in found.items()} if way.every_step else found)
            progress("fitting", batch.numbers.stop, count)
    return [replace(each, problems=dict(sorted(each.problems.items()))) for each in fits]


def batches_of(count: int) -> list[int]:
    """The sizes of the batches in which ``count`` faces are fitted, large ones first.

    One thread reads and cuts a batch: a single device takes large ones only where there is one for every thread.
    """
    least = reading_threads(count) if len(jax.local_devices()) == 1 else 1
    sizes: list[int] = []
    for size in batch_sizes():
        if size == 1 or count // size >= least:
            sizes += [size] * (count // size)
            count %= size
    return sizes


def _in_pictures(crops: Crops, found: _Arrays) -> _Arrays:
    """What was found in crops, in the pixels of the pictures."""

    def points(values: np.ndarray) -> np.ndarray:
        between = (1,) * (values.ndim - 2)  # steps, if there are any, and landmarks
        return to_image(values, crops.scale.reshape(-1, *between, 1), crops.offset.reshape(-1, *between, 2))

    found = {name: values.astype(np.float64) for name, values in found.items()}
    if "landmarks" in found:
        found["landmarks"] = points(found["landmarks"])
    if "landmarks_3d" in found:
        depths = found["landmarks_3d"][..., 2:] * crops.scale.reshape(-1, *(1,) * (found["landmarks_3d"].ndim - 1))
        found["landmarks_3d"] = np.concatenate([points(found["landmarks_3d"][..., :2]), depths], -1)
        found["scale"] *= crops.scale.reshape(-1, *(1,) * (found["scale"].ndim - 1))
    return found


def _put(fits: Fits, batch: CutFaces, found: _Arrays) -> None:
    """Put what was found in a batch among the fits; of faces that could not be cut or diverged, why."""
    fits.problems.update(batch.problems)
    cut = np.array([number not in batch.problems for number in batch.numbers])
    finite = np.all([np.isfinite(values.reshape(len(cut), -1)).all(1) for values in found.values()], 0)
    numbers = np.asarray(batch.numbers)
    for name, values in found.items():
        getattr(fits, name)[numbers[cut & finite]] = values[cut & finite]
    for row in map(int, np.flatnonzero(cut & ~finite)):
        fits.problems[batch.numbers[row]] = f"{batch.sources[row]}the fit diverged"


def require_refinable(model: Model, refine: bool) -> None:
    """Check that a model aligns a 3D shape, if that is to be refined.

    Raises:
        InputError: it does not.
    """
    if refine and model.head is None:
        raise InputError("refine: only models of the method alignment3d align a 3D shape that could be refined")


def _unfitted(model: Model, faces: Faces, way: _Way) -> Fits:
    """Fits of faces of which nothing is known yet: NaN."""
    shapes: dict[str, tuple[int, ...]] = {"landmarks": (model.scheme.count, 2)}
    if model.solid is not None:
        modes = len(model.solid.model.deviations)
        shapes |= {"landmarks_3d": (model.scheme.count, 3), "pose": (3,), "scale": (), "b": (modes,)}
    if model.confidence is not None and not way.every_step:
        shapes["confidence"] = ()
    nothing = {name: np.full((len(faces), *shape), np.nan) for name, shape in shapes.items()}
    return Fits(problems={}, pictures=np.arange(len(faces)), boxes=faces.boxes, kinds=faces.kinds, **nothing)


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
    parts = model.cascade, model.head, model.confidence
    if len(jax.local_devices()) == 1 or count < batch_sizes()[0]:
        return lambda crops: _find(*parts, crops, *way, None)
    mesh = _mesh()
    everywhere = jax.device_put(parts, NamedSharding(mesh, PartitionSpec()))
    of_each = NamedSharding(mesh, PartitionSpec("faces"))

    def compute(crops: np.ndarray) -> dict[str, jax.Array]:
        if len(crops) > BATCHES[0]:
            return _find(*everywhere, jax.device_put(crops, of_each), *way, mesh)
        return _find(*parts, crops, *way, None)

    return compute


@partial(jax.jit, static_argnames=("refine", "every_step", "passes", "mesh"))
def _find(
    cascade: Cascade,
    head: CameraASM | None,
    confidence: Confidence | None,
    crops: jax.Array,
    turns: jax.Array | None,
    refine: bool,
    every_step: bool,
    passes: int,
    mesh: Mesh | None,
) -> dict[str, jax.Array]:
    """What is found in crops; by each device of the mesh in its share of them."""

    def of_share(
        cascade: Cascade,
        head: CameraASM | None,
        confidence: Confidence | None,
        turns: jax.Array | None,
        crops: jax.Array,
    ) -> dict:
        return find(cascade, head, crops, turns, refine, every_step, passes, confidence)

    if mesh is not None:
        everything, faces = PartitionSpec(), PartitionSpec("faces")
        of_share = jax.shard_map(
            of_share,
            mesh=mesh,
            in_specs=(everything, everything, everything, everything, faces),
            out_specs=faces,
            check_vma=False,  # loops begin with constants, which all devices share
        )
    return of_share(cascade, head, confidence, turns, crops)


def warm_up(
    model: Model,
    batches: Sequence[int] | None = None,
    initialisations: int = 1,
    refine: bool = False,
    every_step: bool = False,
    passes: int = 1,
) -> None:
    """Compile the model for the batch sizes that ``fit`` uses, all unless told; the first fit is then as fast as the
    others.

    ``passes`` are those of `fit`: 2 where it finds the faces by Haar. With ``every_step`` it is for
    `fitting.fit_steps`, which has a single start whatever ``initialisations`` says.

    Raises:
        InputError: no initialisations, or two, or nothing to refine.
    """
    require_refinable(model, refine)
    side = model.cascade.frame.crop
    turns = None if every_step else start_rotations(initialisations, ANY_ROTATION)
    sizes = batch_sizes() if batches is None else batches
    compute = _computing(model, _Way(turns, refine, every_step, passes), max(sizes, default=0))
    for size in sizes:
        jax.block_until_ready(compute(np.zeros((size, side, side), np.uint8)))
