"""How faces lie in a new kind of box, measured on pictures with such boxes: no landmarks are needed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit.data.detection import best_match, detect_faces
from jaxfit.data.images import read_grey
from jaxfit.data.placements import Placement, measure_placement
from jaxfit.data.records import FaceRecord
from jaxfit.evaluating import Evaluation, evaluate
from jaxfit.exceptions import ImageError, InputError
from jaxfit.fitting import fit
from jaxfit.models.model import SQUARE, Model
from jaxfit.shapes.space import Start

_DETECTOR = "haar-frontal"
_FEWEST = 10
# Degrees of labelled pitch and yaw up to which a head looks straight ahead.
_FRONTAL = 15


def calibrate_boxes(
    model: Model,
    faces: Sequence[FaceRecord],
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Placement:
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
    model.placement(_DETECTOR)
    if not any(face.box is not None for face in faces):
        raise InputError("expected faces with boxes, to learn how faces lie in them; got none")
    boxes, found, pictures = [], [], []
    for number, face in enumerate(faces):
        progress("looking for faces in their boxes", number, len(faces))
        if face.box is None:
            continue
        try:
            grey = read_grey(face.image)
        except ImageError:
            continue
        match = best_match(detect_faces(grey), face.box)
        if match is not None and match.kind == _DETECTOR:
            boxes.append(face.box)
            found.append(match.box)
            pictures.append(grey)
    progress("looking for faces in their boxes", len(faces), len(faces))
    if len(found) < _FEWEST:
        raise InputError(
            f"expected at least {_FEWEST} faces that the detector finds in their boxes; found {len(found)}"
        )
    fits = fit(model, pictures, np.array(found), kind=_DETECTOR)
    frame, space = model.cascade.frame, model.cascade.space
    mean = space.landmarks(space.place(Start(jnp.zeros(2), jnp.ones(()), jnp.zeros(()))))
    centred = np.asarray(mean - mean.mean(0), np.float64)
    return measure_placement(np.array(boxes)[fits.ok], fits.landmarks[fits.ok], centred, frame.face)


def frontal(face: FaceRecord) -> bool:
    """Whether a head looks straight ahead, as far as is known: whether its box tells how faces lie in boxes."""
    return face.pose is None or not bool((np.abs(face.pose[1:]) > _FRONTAL).any())


def evaluate_in_own_boxes(
    models: Mapping[str, Model],
    faces: Sequence[FaceRecord],
    calibrator: Model,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
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
    for subject in subjects:
        tested = [face for face in faces if face.subject == subject]
        others = [face for face in faces if face.subject != subject and frontal(face)]
        placement = calibrate_boxes(calibrator, others, progress)
        boxes = np.array([np.full(4, np.nan) if face.box is None else face.box for face in tested])
        for name, model in models.items():
            placed = replace(model, placements={**model.placements, SQUARE: placement})
            parts[name].append(evaluate(placed, tested, boxes, progress=progress))
    return {name: _joined(results) for name, results in parts.items()}


def _joined(results: Sequence[Evaluation]) -> Evaluation:
    """Evaluations of several sets of faces as one."""
    arrays: dict[str, Any] = {
        name: None if getattr(results[0], name) is None else np.concatenate([getattr(each, name) for each in results])
        for name in ("boxes", "landmarks", "errors", "pose", "errors_3d")
    }
    firsts = np.cumsum([0, *(len(each.faces) for each in results)])
    problems = {
        int(first) + number: why
        for first, each in zip(firsts, results, strict=False)
        for number, why in each.problems.items()
    }
    return replace(results[0], faces=sum((each.faces for each in results), ()), problems=problems, **arrays)
