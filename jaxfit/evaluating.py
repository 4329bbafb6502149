"""Measuring a model on labelled faces: starting boxes, fits, errors; every face is accounted for."""

import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.aligning import with_depth
from jaxfit.cascade.fit import ANY_ROTATION, check_rotations
from jaxfit.data.boxes import bounding_square, box_centre, jitter
from jaxfit.data.detectors import Detection, Detector, best_match
from jaxfit.data.detectors.whole import KIND as WHOLE
from jaxfit.data.images import read_grey, read_image
from jaxfit.data.records import FaceRecord
from jaxfit.detecting import find_faces
from jaxfit.evaluation.errors import nmed, normaliser_length
from jaxfit.evaluation.pose import in_order
from jaxfit.exceptions import InputError
from jaxfit.fitting import Fits, batches_of, fit, fit_steps, warm_up
from jaxfit.models.model import SQUARE, Model
from jaxfit.processes import exchanged, gathered, require_same, share_of
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
        seconds_per_face: reading, cropping and fitting, compiled, until the last process has its share; NaN if nothing
            was fitted.
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


def detected_boxes(
    faces: Sequence[FaceRecord],
    detector: str | Detector,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> tuple[np.ndarray, list[str]]:
    """The boxes (N, 4) in which a detector finds labelled faces, and their kinds; NaN, and squares, where it does not.

    Processes that are joined share the pictures, as in `evaluate`.

    Args:
        faces: N labelled faces with landmarks.
        detector: as in ``jaxfit.detect_faces``.
        progress: called with the stage's name, pictures done and pictures in all.

    Raises:
        InputError: there is no such detector.
    """
    pictures = {picture: number for number, picture in enumerate(dict.fromkeys(face.image for face in faces))}
    names = list(pictures)
    mine = share_of(names)
    stored = partial(read_image, exif=False)  # what labels belong to
    found = find_faces([names[number] for number in mine], detector, read=stored, progress=progress)
    in_pictures: list[list[Detection]] = [[] for _ in pictures]
    for part in exchanged([mine[found.pictures].tolist(), found.boxes.tolist(), found.kinds]):
        for picture, box, kind in zip(*part, strict=True):
            in_pictures[picture].append(Detection(np.array(box), kind))
    boxes, kinds = np.tile(_NO_BOX, (len(faces), 1)), [SQUARE] * len(faces)
    for number, face in enumerate(faces):
        if not face.present.any():
            continue
        candidates, truth = in_pictures[pictures[face.image]], bounding_square(face.landmarks)
        whole = [candidate for candidate in candidates if candidate.kind == WHOLE]  # found wherever the face is
        if match := next(iter(whole), None) or best_match(candidates, truth):
            boxes[number], kinds[number] = match.box, match.kind
    return boxes, kinds


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
    kind: str | Sequence[str] = SQUARE,
    scheme: Scheme | None = None,
    normaliser: str = "outer",
    initialisations: int = 1,
    rotations: tuple[float, float] = ANY_ROTATION,
    refine: bool = False,
    passes: int = 1,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
    read: Callable[[Path], np.ndarray] = read_grey,
) -> Evaluation:
    """Fit labelled faces from given boxes and measure the errors.

    Processes that are joined (``jaxfit.join_processes``) share the pictures, and get the results of all.

    Args:
        model: the model.
        faces: N labelled faces.
        boxes: (N, 4) x, y, width, height in pixels; a NaN box is an undetected face: a failure.
        kind: what drew the boxes, as in ``jaxfit.fit``: one for all, or N.
        scheme: what the labels mean, if not what the model's landmarks do: fits are converted to it.
        normaliser: ``"outer"`` eye corners, ``"pupil"`` centres or bounding ``"box"`` side.
        initialisations: starts for each face, as in ``jaxfit.fit``.
        rotations: lowest and highest rotation of the starts, in degrees.
        refine: as in ``jaxfit.fit``.
        passes: as in ``jaxfit.fit``.
        progress: called with the stage's name, faces done and faces in all.
        read: gets a picture's path and returns it grey, uint8 (H, W); it is called in threads.

    Raises:
        InputError: labels of another number of landmarks, a scheme that fits cannot be converted to, boxes of another
            number, an unknown normaliser or kind, no or two initialisations, no range of rotations, or processes that
            were not told the same.
        ProcessError: another of the processes ended.
    """
    kinds = [kind] * len(faces) if isinstance(kind, str) else list(kind)
    if len(kinds) != len(faces):
        raise InputError(f"expected one kind of box, or one for each of {len(faces)} faces; got {len(kinds)}")
    for each in {*kinds}:
        model.placement(each)
    check_rotations(initialisations, rotations)

    def fitted(images: Sequence[Path], boxes: np.ndarray, numbers: np.ndarray) -> list[Fits]:
        ways: dict[str, Any] = {"initialisations": initialisations, "rotations": rotations}
        ways |= {"refine": refine, "passes": passes}
        drawn_by = [kinds[number] for number in numbers]
        return [fit(model, images, boxes, kind=drawn_by, read=read, progress=progress, **ways)]

    compiled = partial(warm_up, model, initialisations=initialisations, refine=refine, passes=passes)
    (evaluation,) = _evaluate(model, faces, boxes, scheme or model.scheme, normaliser, compiled, fitted, progress)
    return evaluation


def evaluate_steps(
    model: Model,
    faces: Sequence[FaceRecord],
    boxes: np.ndarray,
    *,
    normaliser: str = "outer",
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
    read: Callable[[Path], np.ndarray] = read_grey,
) -> list[Evaluation]:
    """What `evaluate` tells of the model's first step alone, of its first two, and so on to all; fitted only once.

    Args:
        model: the model.
        faces: N labelled faces.
        boxes: (N, 4), squares around the landmarks, give or take.
        normaliser: as in `evaluate`, like all below.
        progress: called with the stage's name, faces done and faces in all.
        read: gets a picture's path and returns it grey, uint8 (H, W); it is called in threads.

    Raises:
        InputError: as `evaluate`.
    """
    compiled = partial(warm_up, model, every_step=True)

    def fitted(images: Sequence[Path], boxes: np.ndarray, numbers: np.ndarray) -> list[Fits]:
        return fit_steps(model, images, boxes, read=read, progress=progress)

    return _evaluate(model, faces, boxes, model.scheme, normaliser, compiled, fitted, progress)


def _evaluate(
    model: Model,
    faces: Sequence[FaceRecord],
    boxes: np.ndarray,
    scheme: Scheme,
    normaliser: str,
    compiled: Callable[[Sequence[int]], None],
    fitted: Callable[[Sequence[Path], np.ndarray, np.ndarray], list[Fits]],
    progress: Callable[[str, int, int], None],
) -> list[Evaluation]:
    """An evaluation for each of the fits that ``fitted`` makes of files of pictures, their boxes (N, 4) and the numbers
    (N,) of the faces."""
    boxes = np.asarray(boxes, np.float64)
    if boxes.shape != (len(faces), 4):
        raise InputError(f"expected one box for each of {len(faces)} faces, ({len(faces)}, 4); got {boxes.shape}")
    sources(model.scheme, scheme)  # a wrong scheme or normaliser stops before the work
    require_scheme(scheme, faces)
    normaliser_length(np.empty((0, scheme.count, 2)), scheme, normaliser)
    boxed = np.flatnonzero(np.isfinite(boxes).all(1))
    unboxed = np.flatnonzero(~np.isfinite(boxes).all(1))
    require_same(model.cascade, model.head, scheme.name, [face.face for face in faces], boxes)
    mine = share_of([faces[int(number)].image for number in boxed])
    own = boxed[mine]
    if own.size:
        progress("compiling (cached for later runs)", 0, len(faces))
        compiled(list(dict.fromkeys(batches_of(own.size))))
    begin = time.perf_counter()
    fits = fitted([faces[int(number)].image for number in own], boxes[own], own)
    seconds = max(exchanged(time.perf_counter() - begin))

    def whole(found: np.ndarray) -> np.ndarray:
        """What the processes found of faces with boxes, of all faces; NaN for the others."""
        values = np.full((len(faces), *found.shape[1:]), np.nan)
        values[boxed] = gathered(found, mine, boxed.size)
        return values

    unknown = np.full((scheme.count, 2), np.nan)
    truth = np.array([face.landmarks if len(face.landmarks) else unknown for face in faces])
    truth = truth.reshape(-1, scheme.count, 2)
    solid_truth = _solid_truth(model, scheme, truth)
    evaluations = []
    for each in fits:
        problems = {int(number): f"{faces[int(number)].image}: no face box" for number in unboxed}
        left_out = [(int(own[row]), why) for row, why in each.problems.items()]
        problems |= dict(sorted(one for part in exchanged(left_out) for one in part))
        landmarks = whole(convert(each.landmarks, model.scheme, scheme))
        pose = None if each.pose is None else whole(each.pose)
        errors_3d = None
        if each.landmarks_3d is not None:
            solid = whole(convert(each.landmarks_3d, model.scheme, scheme))
            errors_3d = nmed(solid, solid_truth, scheme, normaliser)
        evaluations.append(
            Evaluation(
                faces=tuple(faces),
                boxes=boxes,
                landmarks=landmarks,
                errors=nmed(landmarks, truth, scheme, normaliser),
                normaliser=normaliser,
                problems=problems,
                seconds_per_face=seconds / boxed.size if boxed.size else float("nan"),
                pose=pose,
                errors_3d=errors_3d,
            )
        )
    return evaluations


def _solid_truth(model: Model, scheme: Scheme, truth: np.ndarray) -> np.ndarray:
    """The labels (N, L, 3) with depths; NaN where they are none of the 3D shape, or too few to give it depth."""
    if model.solid is None or scheme != model.scheme:
        return np.full((*truth.shape[:2], 3), np.nan)
    return with_depth(truth, model.solid.model)


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
