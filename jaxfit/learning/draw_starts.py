"""Good and bad starts of fits, drawn for labelled faces, and for what is none: what a confidence learns from."""

import zlib
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from jaxfit.data.boxes import bounding_square, box_centre, jitter
from jaxfit.data.crops import Crops, cut
from jaxfit.data.detectors.detector import overlap
from jaxfit.data.pictures import Read, to_grey
from jaxfit.errors import ImageError, InputError
from jaxfit.labels.records import FaceRecord
from jaxfit.models.model import SQUARE, Model
from jaxfit.schemes.scheme import mirrored
from jaxfit.types import Progress

# How fits may begin. Boxes like a detector's are what a confidence is mostly for.
DETECTED, LOST, ELSEWHERE, PART, UPSIDE_DOWN, PATTERN = (
    "detected",
    "lost",
    "elsewhere",
    "part",
    "upside down",
    "pattern",
)
NO_FACES = (ELSEWHERE, PART, PATTERN)
_OF_EACH_FACE = (DETECTED, DETECTED, DETECTED, LOST, ELSEWHERE, PART, UPSIDE_DOWN, PATTERN)

_APART = 0.15  # overlap (IoU) with the face below which a box is elsewhere
_TRIES = 50  # to find such a box: where a face fills its picture there is none


class DrawnStarts(NamedTuple):
    """What N fits begin with.

    Attributes:
        crops: (N, H, H) uint8.
        truth: (N, L, 2) the true landmarks, in crop pixels; NaN where there is no face.
        starts: (N,) how each begins.
        faces: (N,) the number of each one's face.
    """

    crops: np.ndarray
    truth: np.ndarray
    starts: np.ndarray
    faces: np.ndarray


def draw_starts(
    model: Model, faces: Sequence[FaceRecord], seed: int, read: Read, progress: Progress
) -> tuple[DrawnStarts, tuple[str, ...]]:
    """Starts of each kind for all faces that are complete and can be read; and what could not be read and why."""
    if other := next((face for face in faces if len(face.landmarks) != model.scheme.count), None):
        raise InputError(f"expected faces of {model.scheme.count} landmarks, as the model's; {other.image} has others")
    frame, placement = model.cascade.frame, model.placement(SQUARE)
    crops, truths, starts, numbers = [], [], [], []
    problems: list[str] = []
    crop = Crops.empty(1, frame)
    for number, face in enumerate(faces):
        progress("drawing starts", number, len(faces))
        if not face.complete:
            continue
        try:
            upright = to_grey(read(face.image))
        except ImageError as error:
            problems.append(str(error))
            continue
        rng = np.random.default_rng([seed, zlib.crc32(face.face.encode())])
        for start in _OF_EACH_FACE:
            picture, points = upright, face.landmarks
            height, width = picture.shape
            if model.scheme.mirror is not None and rng.random() < 0.5:
                picture, points = picture[:, ::-1], mirrored(points, width, model.scheme)
            if start == UPSIDE_DOWN:
                picture, points = picture[::-1, ::-1], np.array([width - 1, height - 1]) - points
            if start == PATTERN:
                pixels, points = _pattern(rng, frame.crop), np.full_like(points, np.nan)
            else:
                box = box_of_start(start, bounding_square(points), picture.shape, rng)
                if box is None:
                    continue
                cut(picture, *placement.face_in(box), crop, 0)
                pixels, points = crop.pixels[0].copy(), crop.from_images(points[None])[0]
            crops.append(pixels)
            truths.append(points)
            starts.append(start)
            numbers.append(number)
    progress("drawing starts", len(faces), len(faces))
    if not crops:
        raise InputError("expected a face with all landmarks and a picture that can be read; got none")
    drawn = DrawnStarts(np.stack(crops), np.stack(truths), np.array(starts), np.array(numbers))
    return drawn, tuple(dict.fromkeys(problems))


def box_of_start(start: str, square: np.ndarray, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray | None:
    """A box (4,) of this kind, for a face in this square (4,) of a picture (H, W); None: there is none."""
    if start in (DETECTED, UPSIDE_DOWN):
        return jitter(square, rng, rng.uniform(0.06, 0.15), rng.uniform(0.08, 0.2))
    side = square[2]
    if start == LOST:
        return _around(
            box_centre(square) + side * rng.uniform(-0.5, 0.5, 2), side * np.exp(rng.uniform(-1, 1) * np.log(2))
        )
    if start == PART:
        small = side * rng.uniform(0.15, 0.4)
        return np.array([*(square[:2] + rng.uniform(0, side - small, 2)), small, small])
    for _ in range(_TRIES):
        box = _around(rng.uniform((0, 0), shape[1::-1]), side * np.exp(rng.uniform(np.log(0.4), np.log(1.5))))
        if overlap(box, square) < _APART:
            return box
    return None


def _around(centre: np.ndarray, side: float) -> np.ndarray:
    return np.array([*(centre - side / 2), side, side])


def _pattern(rng: np.random.Generator, side: int) -> np.ndarray:
    """A picture (side, side), uint8, of nothing: plain, a slope, stripes, or noise, coarse or fine."""
    y, x = np.mgrid[:side, :side] / side
    angle = rng.uniform(0, 2 * np.pi)
    along = x * np.cos(angle) + y * np.sin(angle)
    kind = rng.choice(["plain", "slope", "stripes", "noise"])
    picture: np.ndarray
    if kind == "noise":
        coarseness = side * np.exp(rng.uniform(np.log(0.002), np.log(0.15)))
        picture = np.asarray(cv2.GaussianBlur(rng.normal(size=(side, side)), (0, 0), coarseness), np.float64)
    elif kind == "stripes":
        picture = np.sin(2 * np.pi * (along * np.exp(rng.uniform(np.log(1), np.log(20))) + rng.random()))
    else:
        picture = along if kind == "slope" else np.zeros_like(x)
    contrast = rng.uniform(10, 70) / max(float(picture.std()), 1e-6)
    grain = rng.normal(0, rng.choice([0, 2, 8]), picture.shape)
    return (rng.uniform(40, 210) + contrast * (picture - picture.mean()) + grain).clip(0, 255).astype(np.uint8)
