"""Fitting pictures: boxes to crops, crops through the cascade in fixed-size batches, landmarks back to the pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxfit.cascade.fit import ANY_ROTATION, fit_crops, fit_heads, start_rotations
from jaxfit.data.boxes import box_problem
from jaxfit.data.crops import Crops, cut
from jaxfit.data.images import to_grey
from jaxfit.exceptions import ImageError, InputError
from jaxfit.models.model import SQUARE, Model

# Every number of faces is served by batches of these sizes: three compilations, whatever comes.
BATCHES = (64, 8, 1)


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


def crop_faces(
    model: Model, images: Sequence[np.ndarray] | np.ndarray, boxes: ArrayLike, kind: str | Sequence[str] = SQUARE
) -> tuple[Crops, dict[int, str]]:
    """Cut the crops that the model's cascade works on.

    Args:
        model: whose crops.
        images: N uint8 pictures of any sizes, (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA; the same array may come
            several times, once for each of its faces.
        boxes: (N, 4) x, y, width, height of the faces, in pixels.
        kind: what drew the boxes, one of ``model.placements``; or N of them.

    Returns:
        The crops; and for each face that cannot be cut (its crop is black) its number and why.

    Raises:
        InputError: ``boxes`` is not (N, 4), or ``kind`` is unknown.
    """
    if isinstance(images, np.ndarray) and (images.ndim == 2 or (images.shape[-1] in (3, 4) and images.ndim == 3)):
        raise InputError(f"expected a sequence of images, got one array {images.shape}; put it in a list")
    boxes = _box_array(boxes, len(images))
    kinds = [kind] * len(images) if isinstance(kind, str) else list(kind)
    if len(kinds) != len(images):
        raise InputError(f"expected one kind of box, or one for each of {len(images)} images; got {len(kinds)}")
    placements = [model.placement(kind) for kind in kinds]
    crops = Crops.empty(len(images), model.cascade.frame)
    problems: dict[int, str] = {}
    for number, (image, box) in enumerate(zip(images, boxes, strict=True)):
        try:
            grey = to_grey(image)
        except ImageError as error:
            problems[number] = str(error)
            continue
        if complaint := box_problem(box, grey.shape):
            problems[number] = complaint
            continue
        cut(grey, *placements[number].face_in(box), crops, number)
    return crops, problems


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


def fit(
    model: Model,
    images: Sequence[np.ndarray] | np.ndarray,
    boxes: ArrayLike,
    *,
    kind: str | Sequence[str] = SQUARE,
    initialisations: int = 1,
    rotations: tuple[float, float] = ANY_ROTATION,
    refine: bool = False,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Fits:
    """Find the landmarks of N faces, and their 3D shapes and poses if the model knows of them.

    A picture or box that cannot be used does not stop the others: its landmarks are NaN and ``problems`` says why.

    Args:
        model: from ``jaxfit.load``.
        images: N uint8 pictures of any sizes, (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA; for several faces in one
            picture give the same array several times.
        boxes: (N, 4) x, y, width, height of the faces, in pixels.
        kind: what drew the boxes: ``"square"`` are squares around the landmarks, give or take; the others that a model
            knows stand in ``model.placements``. One for all, or N of them.
        initialisations: starts for each face, one or at least three, turned evenly over ``rotations``; the fit nearest
            to all others is kept (thesis 3.2.3). Worth their time, a multiple of one start's, where faces may be
            turned in the picture and the model was trained for it.
        rotations: lowest and highest rotation of the starts, in degrees, clockwise as seen; a single start is in the
            middle.
        refine: for models of 3D alignment, adjust shape and camera together after it; slow.
        progress: called with the stage's name, faces done and faces in all.

    Raises:
        InputError: ``boxes`` is not (N, 4), ``kind`` is unknown, there are no initialisations or no range, or nothing
            to refine.
    """
    turns = start_rotations(initialisations, rotations)
    require_refinable(model, refine)
    fit_batch = partial(_fit_batch, model, turns=turns, refine=refine)
    (fits,) = _fits(model, images, boxes, kind, 1, fit_batch, progress)
    return fits


def fit_steps(
    model: Model,
    images: Sequence[np.ndarray] | np.ndarray,
    boxes: ArrayLike,
    *,
    kind: str | Sequence[str] = SQUARE,
) -> list[Fits]:
    """The fits after each step of the cascade, from one start a face; the last are those of `fit`.

    Args:
        model: as in `fit`, like all below.
        images: N pictures.
        boxes: (N, 4), in pixels.
        kind: what drew the boxes.

    Raises:
        InputError: as `fit`.
    """
    steps = len(model.cascade.windows)
    return _fits(model, images, boxes, kind, steps, partial(_fit_batch, model, every_step=True), lambda *_: None)


def _fits(
    model: Model,
    images: Sequence[np.ndarray] | np.ndarray,
    boxes: ArrayLike,
    kind: str | Sequence[str],
    count: int,
    fit_batch: Callable[[jax.Array], list[dict[str, np.ndarray]]],
    progress: Callable[[str, int, int], None],
) -> list[Fits]:
    """``count`` fits of each picture, which ``fit_batch`` makes of crops."""
    crops, problems = crop_faces(model, images, boxes, kind)
    usable = np.array([number for number in range(len(images)) if number not in problems], int)
    batches, done = [], 0
    for size in _batch_sizes(len(usable)):
        progress("fitting", done, len(usable))
        batches.append(fit_batch(jnp.asarray(crops.pixels[usable[done : done + size]])))
        done += size
    progress("fitting", done, len(usable))
    if not batches:
        return [Fits(problems=problems, **_empty(model, len(images)))] * count
    return [_in_images(model, crops, usable, parts, problems) for parts in zip(*batches, strict=True)]


def _in_images(
    model: Model, crops: Crops, usable: np.ndarray, parts: Sequence[dict[str, np.ndarray]], problems: dict[int, str]
) -> Fits:
    """What was found in batches of the ``usable`` crops, in the pixels of the pictures."""
    problems = dict(problems)
    found = _empty(model, len(crops.scale))
    for name, values in found.items():
        values[usable] = np.concatenate([part[name] for part in parts])
    for name in ("landmarks", "landmarks_3d"):
        if name in found:
            found[name][usable, :, :2] = crops.to_images(found[name][usable, :, :2], usable)
    if model.solid is not None:
        found["landmarks_3d"][usable, :, 2] *= crops.scale[usable, None]
        found["scale"][usable] *= crops.scale[usable]
    for number in usable:
        if not all(np.isfinite(values[number]).all() for values in found.values()):
            problems[int(number)] = "the fit diverged"
            for values in found.values():
                values[number] = np.nan
    return Fits(problems=problems, **found)


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


def _fit_batch(
    model: Model, crops: jax.Array, turns: jax.Array | None = None, refine: bool = False, every_step: bool = False
) -> list[dict[str, np.ndarray]]:
    """What is found in crops, by its name in `Fits`, in crop pixels; with ``every_step``, after each step."""
    if model.solid is None:
        found = {"landmarks": fit_crops(model.cascade, crops, turns, every_step)}
    else:
        found = fit_heads(model.cascade, crops, turns, model.head, refine, every_step)._asdict()
    arrays = {name: np.asarray(values) for name, values in found.items()}
    if not every_step:
        return [arrays]
    steps = len(model.cascade.windows)
    return [{name: values[:, step] for name, values in arrays.items()} for step in range(steps)]


def _batch_sizes(count: int) -> list[int]:
    """Sizes of the batches that ``count`` faces are fitted in: large ones first, as many as are full."""
    sizes = []
    for size in BATCHES:
        sizes += [size] * (count // size)
        count %= size
    return sizes


def warm_up(
    model: Model,
    batches: Sequence[int] = BATCHES,
    initialisations: int = 1,
    refine: bool = False,
    every_step: bool = False,
) -> None:
    """Compile the model for the batch sizes that ``fit`` uses, or with ``every_step`` `fit_steps`; the first fit is
    then as fast as the others.

    Raises:
        InputError: no initialisations, or two, or nothing to refine.
    """
    require_refinable(model, refine)
    side = model.cascade.frame.crop
    turns = None if every_step else start_rotations(initialisations, ANY_ROTATION)
    for size in batches:
        _fit_batch(model, jnp.zeros((size, side, side), jnp.uint8), turns, refine, every_step)
