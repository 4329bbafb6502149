"""Fitting pictures: boxes to crops, crops through the cascade in fixed-size batches, landmarks back to the pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxfit.cascade.fit import ANY_ROTATION, fit_crops, start_rotations
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
    """

    landmarks: np.ndarray
    problems: dict[int, str]

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
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Fits:
    """Find the landmarks of N faces.

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
        progress: called with the stage's name, faces done and faces in all.

    Raises:
        InputError: ``boxes`` is not (N, 4), ``kind`` is unknown, there are no initialisations or no range.
    """
    turns = start_rotations(initialisations, rotations)
    crops, problems = crop_faces(model, images, boxes, kind)
    landmarks = np.full((len(images), model.scheme.count, 2), np.nan)
    usable = np.array([number for number in range(len(images)) if number not in problems], int)
    done = 0
    for size in _batch_sizes(len(usable)):
        progress("fitting", done, len(usable))
        rows = usable[done : done + size]
        fitted = fit_crops(model.cascade, jnp.asarray(crops.pixels[rows]), turns)
        landmarks[rows] = crops.to_images(np.asarray(fitted, np.float64), rows)
        done += size
    progress("fitting", done, len(usable))
    for number in usable[~np.isfinite(landmarks[usable]).all((1, 2))]:
        problems[int(number)] = "the fit diverged"
        landmarks[number] = np.nan
    return Fits(landmarks, problems)


def _batch_sizes(count: int) -> list[int]:
    """Sizes of the batches that ``count`` faces are fitted in: large ones first, as many as are full."""
    sizes = []
    for size in BATCHES:
        sizes += [size] * (count // size)
        count %= size
    return sizes


def warm_up(model: Model, batches: Sequence[int] = BATCHES, initialisations: int = 1) -> None:
    """Compile the model for the batch sizes that ``fit`` uses; the first fit is then as fast as the others.

    Raises:
        InputError: no initialisations, or two.
    """
    side = model.cascade.frame.crop
    turns = start_rotations(initialisations, ANY_ROTATION)
    for size in batches:
        jax.block_until_ready(fit_crops(model.cascade, jnp.zeros((size, side, side), jnp.uint8), turns))
