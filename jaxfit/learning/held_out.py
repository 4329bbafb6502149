"""What errors a training leaves on faces that it does not learn from, where there are too few to keep some aside."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxfit.data.detectors import all_rough
from jaxfit.data.detectors.whole import KIND as WHOLE
from jaxfit.data.pictures import GreyPictures, Read, picture_size
from jaxfit.errors import ImageError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.evaluate import Evaluation, evaluate
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.fitting.pipeline import Fitting
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.methods import Options
from jaxfit.learning.prepare import part_of, usable_faces
from jaxfit.learning.train import train
from jaxfit.models.model import SQUARE
from jaxfit.modes import computing
from jaxfit.schemes.scheme import Scheme
from jaxfit.types import Progress, silent


@computing
def evaluate_held_out(
    faces: Sequence[FaceRecord],
    scheme: Scheme,
    *,
    method: str = "sdm",
    options: Options = Options(),
    folds: int = 5,
    read: Read | None = None,
    progress: Progress = silent,
) -> dict[str, Evaluation]:
    """Train in folds, each time without a part of the subjects, and fit the faces of that part.

    Args:
        faces: the labelled faces; those with missing landmarks are left out.
        scheme: what their landmarks mean.
        method: as in `train`.
        options: how to train; the detectors are not run.
        folds: how many parts there are; as many as subjects leave one out at a time.
        read: gets a picture's path and returns it grey, uint8 (H, W); the default remembers them.
        progress: called with a stage's name, what is done and what there is to do.

    Returns:
        By the kind of box that fits started from: ``"square"``, those of `start_boxes`; and ``"whole"`` pictures, where
        all of the models have learned how objects lie in them.

    Raises:
        InputError: fewer than two folds, fewer subjects than folds, or as `train`.
    """
    read = read or GreyPictures()
    usable, _ = usable_faces(faces, scheme)
    parts = split_by_subject([face.subject for face in usable], folds, options.greedy.seed)
    found: dict[str, list[Evaluation]] = {SQUARE: [], WHOLE: []}
    for fold in range(folds):
        learned = [face for face, part in zip(usable, parts, strict=True) if part != fold]
        tested = [face for face, part in zip(usable, parts, strict=True) if part == fold]
        how: dict[str, Any] = {"read": read, "progress": part_of(progress, f"fold {fold + 1}/{folds}")}
        model = train(learned, scheme, method=method, options=options.but(detectors=False), **how).model
        boxes = {SQUARE: start_boxes(tested, options.greedy.seed)}
        if WHOLE in model.placements:
            boxes[WHOLE] = np.stack([_whole_picture(face) for face in tested])
        for kind, of_kind in boxes.items():
            passes = Fitting().passes_from(all_rough([kind]))
            starts = options.starts
            found[kind].append(evaluate(model, tested, of_kind, kind=kind, starts=starts, passes=passes, **how))
    return {kind: Evaluation.join(each) for kind, each in found.items() if len(each) == folds}


def _whole_picture(face: FaceRecord) -> np.ndarray:
    """The box (4,) of a face's whole picture; NaN if it cannot be read."""
    try:
        return np.array([0, 0, *picture_size(face.image)], np.float64)
    except ImageError:
        return np.full(4, np.nan)
