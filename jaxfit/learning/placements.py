"""How faces lie in a new kind of box, measured on pictures with such boxes: no landmarks are needed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jaxfit.data.detectors import best_match, detect_faces
from jaxfit.data.pictures import read_grey
from jaxfit.errors import ImageError, InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.evaluate import Evaluation, evaluate
from jaxfit.fitting.fit import fit
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.models.files import load
from jaxfit.models.model import SQUARE, Model
from jaxfit.models.placements import Placement, measure_placement
from jaxfit.modes import computing
from jaxfit.schemes.known import IBUG68, NO_LANDMARKS
from jaxfit.types import Progress, silent

_DETECTOR = "haar-frontal"
# Measures the boxes of datasets without landmarks, and what models it can tell them to.
_CALIBRATOR, CALIBRATED = "sdm68", IBUG68
_FEWEST = 10
_SHOWN = 3  # problems that an error names
# Degrees of labelled pitch and yaw up to which a head looks straight ahead.
_FRONTAL = 15


@dataclass(frozen=True)
class Calibrated:
    """What the calibration of boxes gives.

    Attributes:
        placement: how faces lie in the boxes.
        faces: number of faces that it was measured on.
        problems: which pictures could not be read and why, a sentence each.
    """

    placement: Placement
    faces: int
    problems: tuple[str, ...]


@computing
def calibrate_boxes(
    model: Model,
    faces: Sequence[FaceRecord],
    *,
    progress: Progress = silent,
) -> Calibrated:
    """How faces lie in the boxes of ``faces``, for ``model.placements`` under a name of yours.

    Faces that OpenCV's frontal detector finds in their boxes are fitted from its boxes, which the model knows; the fits
    take the place of labels. Turned faces are rarely found, so that it is the boxes of frontal ones that are measured.

    Args:
        model: trained with the Haar detectors.
        faces: with pictures and boxes; their landmarks are not used.
        progress: called with the stage's name, faces done and faces in all.

    Raises:
        InputError: the model does not know the detector's boxes, or no face has a box, or fewer than ten were found.
    """
    if not any(face.box is not None for face in faces):
        raise InputError("expected faces with boxes, to learn how faces lie in them; got none")
    fitted, problems = _fitted_in_boxes(model, faces, progress)
    try:
        return Calibrated(_placement(model, list(fitted.values())), len(fitted), problems)
    except InputError as error:
        raise InputError("; ".join([str(error), *problems[:_SHOWN]])) from None


class _Fitted(NamedTuple):
    """A face that was found in its box: ``box`` (4,), and its fitted ``landmarks`` (L, 2), in pixels."""

    box: np.ndarray
    landmarks: np.ndarray


def _fitted_in_boxes(
    model: Model, faces: Sequence[FaceRecord], progress: Progress
) -> tuple[dict[int, _Fitted], tuple[str, ...]]:
    """By number, the faces that the detector finds in their boxes, fitted; and what could not be read and why."""
    model.placement(_DETECTOR)
    numbers, found, pictures = [], [], []
    problems: list[str] = []
    for number, face in enumerate(faces):
        progress("looking for faces in their boxes", number, len(faces))
        if face.box is None:
            continue
        try:
            grey = read_grey(face.image)
        except ImageError as error:
            problems.append(str(error))
            continue
        match = best_match(detect_faces(grey, "haar"), face.box)
        if match is not None and match.kind == _DETECTOR:
            numbers.append(number)
            found.append(match.box)
            pictures.append(grey)
    progress("looking for faces in their boxes", len(faces), len(faces))
    fits = fit(model, pictures, np.array(found).reshape(-1, 4), kind=_DETECTOR)
    fitted = {
        number: _Fitted(np.asarray(faces[number].box), landmarks)
        for number, landmarks, ok in zip(numbers, fits.landmarks, fits.ok, strict=True)
        if ok
    }
    return fitted, tuple(dict.fromkeys(problems))  # a picture of several faces has one


def _placement(model: Model, fitted: Sequence[_Fitted]) -> Placement:
    """How fitted faces lie in their boxes.

    Raises:
        InputError: fewer than ten.
    """
    if len(fitted) < _FEWEST:
        raise InputError(
            f"expected at least {_FEWEST} faces that the detector finds in their boxes; found {len(fitted)}"
        )
    centred = model.mean_face.astype(np.float64)
    boxes, landmarks = (np.array(each) for each in zip(*fitted, strict=True))
    return measure_placement(boxes, landmarks, centred, model.cascade.frame.face)


def frontal(face: FaceRecord) -> bool:
    """Whether a head looks straight ahead, as far as is known: whether its box tells how faces lie in boxes."""
    return face.pose is None or not bool((np.abs(face.pose[1:]) > _FRONTAL).any())


def evaluate_in_own_boxes(
    models: Mapping[str, Model],
    faces: Sequence[FaceRecord],
    calibrator: Model,
    *,
    progress: Progress = silent,
) -> dict[str, Evaluation]:
    """Evaluate models from the boxes of a dataset that none of them knows, learning nothing from who is tested.

    One subject after the other: how faces lie in the boxes is measured on frontal faces of all others.

    Args:
        models: by name.
        faces: of several subjects, with boxes, and landmarks or none.
        calibrator: model of the same landmarks that measures the boxes, as in `calibrate_boxes`.
        progress: called with the stage's name, faces done and faces in all.

    Returns:
        By name; the faces are sorted by subject.

    Raises:
        InputError: another scheme than the calibrator's, as where a face's centre and size are depends on the
            landmarks; fewer than two subjects; or as `calibrate_boxes`.
    """
    for name, model in models.items():
        if model.scheme != calibrator.scheme:
            raise InputError(f"{name}: expected a model of {calibrator.scheme.name}, as the boxes are measured by one")
    subjects = sorted({face.subject for face in faces})
    if len(subjects) < 2:
        raise InputError("expected faces of two subjects or more: each one's boxes are measured on the others")
    parts: dict[str, list[Evaluation]] = {name: [] for name in models}
    ahead = [face for face in faces if frontal(face)]
    fitted, _ = _fitted_in_boxes(calibrator, ahead, progress)  # what cannot be read is reported where it is tested
    for subject in subjects:
        tested = [face for face in faces if face.subject == subject]
        placement = _placement(calibrator, [fits for n, fits in fitted.items() if ahead[n].subject != subject])
        boxes = np.array([np.full(4, np.nan) if face.box is None else face.box for face in tested])
        for name, model in models.items():
            placed = replace(model, placements={**model.placements, SQUARE: placement})
            parts[name].append(evaluate(placed, tested, boxes, normaliser="box", progress=progress))
    return {name: Evaluation.join(results) for name, results in parts.items()}


def evaluate_pose(
    models: Mapping[str, Model],
    dataset: Dataset,
    seed: int = 0,
    *,
    progress: Progress = silent,
) -> dict[str, Evaluation]:
    """Evaluate models of 3D methods on faces with labelled poses: from the labels' squares, or, without landmarks,
    from the dataset's own boxes as `evaluate_in_own_boxes` does.

    Args:
        models: by name.
        dataset: faces with poses.
        seed: of the squares, as in `start_boxes`.
        progress: called with the stage's name, faces done and faces in all.

    Returns:
        By name; errors of landmarks are relative to their bounding square.

    Raises:
        InputError: as `evaluate` and `evaluate_in_own_boxes`.
    """
    if dataset.scheme == NO_LANDMARKS:
        return evaluate_in_own_boxes(models, dataset.faces, load(_CALIBRATOR), progress=progress)
    boxes = start_boxes(dataset.faces, seed)
    return {
        name: evaluate(model, dataset.faces, boxes, normaliser="box", progress=progress)
        for name, model in models.items()
    }
