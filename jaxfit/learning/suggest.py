"""Which unlabelled pictures to label next: those that a model is unsure of, and that differ from each other."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.boxes import bounding_square, jitter
from jaxfit.errors import InputError
from jaxfit.fitting.fit import fit
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.models.model import Model
from jaxfit.modes import computing
from jaxfit.types import Progress, silent

_STARTS = 5  # of each object, beside the one that found it


@dataclass(frozen=True, eq=False)
class Suggested:
    """Pictures to label, the most useful first.

    Attributes:
        fits: N objects, those of a picture one after the other.
        unsure: (N,) how far apart the fits from several starts lie, as a share of the object's side.
        problems: of pictures that nothing was found in.
    """

    fits: Fits
    unsure: np.ndarray
    problems: tuple[Problem, ...]

    @property
    def dataset(self) -> Dataset:
        """The fits as labels to be corrected."""
        names, pictures = self.fits.names, self.fits.pictures
        faces, found = [], Counter[int]()
        for row, points in enumerate(self.fits.landmarks):
            image, known = Path(names[pictures[row]]), np.ones(len(points), bool)
            found[pictures[row]] += 1
            faces.append(
                FaceRecord(
                    image=image,
                    landmarks=points,
                    present=known,
                    visible=known,
                    box=bounding_square(points),
                    pose=None,
                    subject=image.stem,
                    face=f"{image.stem}_{found[pictures[row]]}",
                )
            )
        return Dataset("suggested", self.fits.scheme, tuple(faces))


@computing
def suggest(
    model: Model,
    pictures: Sequence[Path],
    count: int | None = None,
    *,
    seed: int = 0,
    progress: Progress = silent,
    **how: Any,
) -> Suggested:
    """Rank unlabelled pictures by what a model would learn from their labels.

    Each object is fitted again from several boxes around where it was found: the farther apart these fits lie, the less
    sure the model is. The first picture is that of which it is least sure; each next one has the highest product of
    that and of how far its shape is from those of the pictures before it and from the mean shape, so that not all show
    the same.

    Args:
        model: trained on what is labelled so far.
        pictures: files without labels.
        count: how many to suggest; None ranks all.
        seed: of the boxes.
        progress: called with a stage's name, what is done and what there is to do.
        how: how objects are found: ``detector``, ``search`` and so on, as ``jaxfit.fit`` takes them.

    Raises:
        InputError: a count below 1, or as ``jaxfit.fit``.
    """
    if count is not None and count < 1:
        raise InputError(f"expected at least one picture to suggest; got a count of {count}")
    found = fit(model, [str(picture) for picture in pictures], progress=progress, **how)
    fits = found[found.fitted]
    if not len(fits):
        return Suggested(fits, np.empty(0), found.problems)
    squares = np.stack([bounding_square(points) for points in fits.landmarks])
    rng = np.random.default_rng(seed)
    boxes = np.stack([jitter(square, rng) for square in squares for _ in range(_STARTS)])
    again = fit(
        model, [fits.names[number] for number in np.repeat(fits.pictures, _STARTS)], boxes, progress=progress
    ).landmarks.reshape(len(fits), _STARTS, -1, 2)
    several = np.concatenate([fits.landmarks[:, None], again], 1) / squares[:, None, None, 2:]
    # A fit that diverged or ran away is as unsure as can be.
    apart = np.nan_to_num(np.linalg.norm(several - np.median(several, 1, keepdims=True), axis=-1), nan=1.0)
    unsure = np.minimum(apart, 1.0).mean((1, 2))
    shapes = (fits.landmarks - squares[:, None, :2]) / squares[:, None, 2:]
    order = ranked(unsure, shapes.reshape(len(fits), -1), _in_square(model.mean_face).reshape(-1))
    chosen = list(dict.fromkeys(fits.pictures[order].tolist()))[:count]
    rows = [row for picture in chosen for row in np.flatnonzero(fits.pictures == picture)]
    return Suggested(fits[rows], unsure[rows], found.problems)


def ranked(unsure: np.ndarray, places: np.ndarray, known: np.ndarray) -> np.ndarray:
    """An order (N,) of objects: each has the highest product of its uncertainty (N,) and of the distance of its place
    (N, D) from the nearest of those before it and from a known place (D,)."""
    nearest = np.linalg.norm(places - known, axis=1)
    left = np.ones(len(places), bool)
    order: list[int] = []
    for _ in range(len(places)):
        best = int(np.argmax(np.where(left, unsure * (nearest if order else 1.0), -1.0)))
        order.append(best)
        left[best] = False
        nearest = np.minimum(nearest, np.linalg.norm(places - places[best], axis=1))
    return np.array(order, int)


def _in_square(points: np.ndarray) -> np.ndarray:
    """Points (L, 2) in sides of the square around them."""
    square = bounding_square(points)
    return np.asarray((points - square[:2]) / square[2])
