"""Measuring a model on labelled faces: starting boxes, fits, errors; every face is accounted for."""

import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxfit.aligning import with_depth
from jaxfit.cascade.fit import ANY_ROTATION, check_rotations
from jaxfit.data.boxes import bounding_square, box_centre, jitter
from jaxfit.data.images import read_image, to_grey
from jaxfit.data.records import FaceRecord
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.pose import in_order
from jaxfit.exceptions import ImageError, InputError
from jaxfit.fitting import BATCHES, fit, warm_up
from jaxfit.models.model import SQUARE, Model
from jaxfit.shapes.conversions import convert, sources
from jaxfit.shapes.schemes import Scheme

_NO_BOX = np.full(4, np.nan)


@dataclass(frozen=True)
class Evaluation:
    """Fits of N labelled faces and their errors.

    Attributes:
        faces: the N faces.
        boxes: (N, 4) the boxes that the fits started from, in pixels; NaN where there was none.
        landmarks: (N, L, 2) the fits, in the pixels of each picture; NaN where there is none.
        errors: (N,) NMED (Eq. 16); ``inf`` where there is no fit, NaN where the truth does not allow to measure.
        normaliser: what the errors are relative to: ``"outer"``, ``"pupil"`` or ``"box"``.
        pose: (N, 3) roll, pitch and yaw of the fits, as in ``jaxfit.Fits``; None, like the next, for 2D models.
        errors_3d: (N,) NMED in 3D, against labels with the depths of the model's own 3D shapes (thesis 4.2); NaN if
            the errors are not measured on the model's own landmarks.
        problems: for each face without a fit, its number and why.
        seconds_per_face: cropping and fitting, compiled, without reading files; NaN if nothing was fitted.
    """

    faces: tuple[FaceRecord, ...]
    boxes: np.ndarray
    landmarks: np.ndarray
    errors: np.ndarray
    normaliser: str
    problems: dict[int, str]
    seconds_per_face: float
    pose: np.ndarray | None = None
    errors_3d: np.ndarray | None = None

    @property
    def true_pose(self) -> np.ndarray:
        """(N, 3) labelled roll, pitch and yaw in degrees, NaN where unknown; each face's in its own order."""
        return np.array([[np.nan] * 3 if face.pose is None else face.pose for face in self.faces]).reshape(-1, 3)

    @property
    def ordered_pose(self) -> np.ndarray:
        """(N, 3) the fits' poses in the orders of the labelled ones, to be compared with them; NaN for 2D models."""
        poses = np.full((len(self.faces), 3), np.nan) if self.pose is None else self.pose
        return in_order(poses, [face.pose_order for face in self.faces])


def start_boxes(faces: Sequence[FaceRecord], seed: int = 0) -> np.ndarray:
    """Boxes (N, 4) to start from: the true landmarks' bounding square, moved by N(0, 6 %) of its side in x and y and
    scaled by exp(N(0, 8 %)).

    A face gets the same box whatever other faces come with it. A face without any landmark gets its own box, as the
    dataset has it, or NaN.

    Raises:
        InputError: a negative seed.
    """
    if seed < 0:
        raise InputError(f"expected a seed of 0 or more; got {seed}")
    boxes = []
    for face in faces:
        rng = np.random.default_rng([seed, zlib.crc32(face.face.encode())])
        own = _NO_BOX if face.box is None else face.box
        boxes.append(jitter(bounding_square(face.landmarks), rng) if face.present.any() else own)
    return np.array(boxes).reshape(-1, 4)


def match_boxes(faces: Sequence[FaceRecord], named: Mapping[str, Sequence[np.ndarray]]) -> np.ndarray:
    """Boxes (N, 4) from those given by picture name; each box goes to one face at most, the nearest pairs first.

    NaN where none is left for a face: it counts as undetected.
    """
    boxes = np.tile(_NO_BOX, (len(faces), 1))
    pictures: dict[Path, list[int]] = {}
    for number, face in enumerate(faces):
        pictures.setdefault(face.image, []).append(number)
    for picture, numbers in pictures.items():
        given = list(named.get(picture.name, []))
        pairs = sorted((_distance(faces[n], box), n, k) for n in numbers for k, box in enumerate(given))
        used: set[int] = set()
        for _, number, k in pairs:
            if k not in used and np.isnan(boxes[number]).all():
                boxes[number] = given[k]
                used.add(k)
    return boxes


def _distance(face: FaceRecord, box: np.ndarray) -> float:
    if not face.present.any():
        return 0.0
    return float(np.hypot(*(box_centre(box) - box_centre(bounding_square(face.landmarks)))))


def evaluate(
    model: Model,
    faces: Sequence[FaceRecord],
    boxes: np.ndarray,
    *,
    kind: str = SQUARE,
    scheme: Scheme | None = None,
    normaliser: str = "outer",
    initialisations: int = 1,
    rotations: tuple[float, float] = ANY_ROTATION,
    refine: bool = False,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Evaluation:
    """Fit labelled faces from given boxes and measure the errors.

    Args:
        model: the model.
        faces: N labelled faces.
        boxes: (N, 4) x, y, width, height in pixels; a NaN box is an undetected face: a failure.
        kind: what drew the boxes, one of ``model.placements``.
        scheme: what the labels mean, if not what the model's landmarks do: fits are converted to it.
        normaliser: ``"outer"`` eye corners, ``"pupil"`` centres or bounding ``"box"`` side.
        initialisations: starts for each face, as in ``jaxfit.fit``.
        rotations: lowest and highest rotation of the starts, in degrees.
        refine: as in ``jaxfit.fit``.
        progress: called with the stage's name, faces done and faces in all.

    Raises:
        InputError: labels of another number of landmarks, a scheme that fits cannot be converted to, boxes of another
            number, an unknown normaliser or kind, no or two initialisations, or no range of rotations.
    """
    boxes = np.asarray(boxes, np.float64)
    if boxes.shape != (len(faces), 4):
        raise InputError(f"expected one box for each of {len(faces)} faces, ({len(faces)}, 4); got {boxes.shape}")
    scheme = scheme or model.scheme
    sources(model.scheme, scheme)  # a wrong scheme stops before the work
    require_scheme(scheme, faces)
    model.placement(kind)
    check_rotations(initialisations, rotations)
    unknown = np.full((scheme.count, 2), np.nan)
    truth = np.array([face.landmarks if len(face.landmarks) else unknown for face in faces])
    truth = truth.reshape(-1, scheme.count, 2)
    solid = np.full((len(faces), scheme.count, 3), np.nan)
    landmarks = np.full_like(truth, np.nan)
    pose = np.full((len(faces), 3), np.nan)
    nmed(landmarks[:0], truth[:0], scheme, normaliser)  # a wrong normaliser stops before the work
    if faces:
        progress("compiling (cached for later runs)", 0, len(faces))
        warm_up(model, [size for size in BATCHES if size <= len(faces)], initialisations, refine)
    problems: dict[int, str] = {}
    seconds, fitted = 0.0, 0
    for first in range(0, len(faces), BATCHES[0]):
        progress("fitting", first, len(faces))
        rows, pictures = [], []
        for number in range(first, min(first + BATCHES[0], len(faces))):
            if not np.isfinite(boxes[number]).all():
                problems[number] = f"{faces[number].image}: no face box"
                continue
            try:
                pictures.append(to_grey(read_image(faces[number].image, exif=False)))
                rows.append(number)
            except ImageError as error:
                problems[number] = str(error)
        begin = time.perf_counter()
        fits = fit(
            model,
            pictures,
            boxes[rows].reshape(-1, 4),
            kind=kind,
            initialisations=initialisations,
            rotations=rotations,
            refine=refine,
        )
        seconds += time.perf_counter() - begin
        fitted += len(rows)
        landmarks[rows] = convert(fits.landmarks, model.scheme, scheme)
        if fits.landmarks_3d is not None and fits.pose is not None:
            solid[rows], pose[rows] = convert(fits.landmarks_3d, model.scheme, scheme), fits.pose
        problems |= {rows[i]: f"{faces[rows[i]].image}: {why}" for i, why in fits.problems.items()}
    progress("fitting", len(faces), len(faces))
    return Evaluation(
        faces=tuple(faces),
        boxes=boxes,
        landmarks=landmarks,
        errors=nmed(landmarks, truth, scheme, normaliser),
        normaliser=normaliser,
        problems=problems,
        seconds_per_face=seconds / fitted if fitted else float("nan"),
        pose=pose if model.solid else None,
        errors_3d=_errors_3d(model, solid, truth, scheme, normaliser),
    )


def _errors_3d(
    model: Model, solid: np.ndarray, truth: np.ndarray, scheme: Scheme, normaliser: str
) -> np.ndarray | None:
    """NMED in 3D (N,); NaN where the labels are none of the 3D shape, or too few to give it depth."""
    if model.solid is None:
        return None
    if scheme != model.scheme:
        return np.full(len(truth), np.nan)
    return nmed(solid, with_depth(truth, model.solid.model), scheme, normaliser)


def require_scheme(scheme: Scheme, faces: Sequence[FaceRecord]) -> None:
    """Check that faces are labelled with as many landmarks as a scheme has, or with none at all.

    Raises:
        InputError: they are not.
    """
    for face in faces:
        if len(face.landmarks) not in (0, scheme.count):
            raise InputError(
                f"the model finds {scheme.count} landmarks ({scheme.name}), but {face.image} is labelled "
                f"with {len(face.landmarks)}; convert both to a scheme they share (--scheme), if there is one, or "
                "train a model on faces labelled like these"
            )
