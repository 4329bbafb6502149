"""How faces lie in a new kind of box, measured on pictures with such boxes: no landmarks are needed."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from jaxfit.data.detection import best_match, detect_faces
from jaxfit.data.images import read_image, to_grey
from jaxfit.data.placements import Placement, measure_placement
from jaxfit.data.records import FaceRecord
from jaxfit.exceptions import ImageError, InputError
from jaxfit.fitting import fit
from jaxfit.models.model import Model
from jaxfit.shapes.space import Start

_DETECTOR = "haar-frontal"
_FEWEST = 10


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
            grey = to_grey(read_image(face.image, exif=False))
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
