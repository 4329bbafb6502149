"""The rival of ``benchmark.py``: dlib's shape predictor (Kazemi and Sullivan, 2014), trained and run on our crops."""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import jaxfit
from jaxfit.data.crops import Crops
from jaxfit.data.pictures import read_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.image.frame import Frame
from jaxfit.labels.records import FaceRecord
from jaxfit.models.model import Model
from jaxfit.schemes.scheme import Scheme, mirrored

try:
    import dlib
except ImportError:
    dlib = None

# dlib's own defaults; with 68 points, a file of some 66 MB.
CASCADES, TREES, DEPTH, SHRINKAGE, PIXELS = 10, 500, 4, 0.1, 400
# Samples of a face and of its mirror image: 20, as by default, but from boxes as the tests have them, too.
BOXES, OVERSAMPLING = 4, 5
# dlib finds whole pixels: crops in which they are small, half a percent of the distance of the eyes.
FINE = Frame(crop=232, face=128.0)


def train_rival(path: Path, model: Model, faces: Sequence[FaceRecord], scheme: Scheme) -> None:
    """Train dlib's shape predictor on faces and their mirror images, from jittered boxes, and write it to a file.

    Raises:
        InputError: no face has a picture.
    """
    crops, numbers = cut_crops(model, FINE, faces, start_boxes(faces))
    if not numbers.size:
        raise InputError("--dlib-train: expected faces with pictures; got none that can be read")
    landmarks = crops.from_images(np.stack([faces[number].landmarks for number in numbers]))
    sides = np.stack([rectangles(crops, start_boxes(faces, seed)[numbers]) for seed in range(BOXES)], 1)
    pictures, labels = list(crops.pixels), [detections(*of) for of in zip(landmarks, sides, strict=True)]
    if scheme.mirror is not None:
        pictures += [np.ascontiguousarray(crop[:, ::-1]) for crop in crops.pixels]
        turned = np.stack([FINE.crop - 1 - sides[..., 2], sides[..., 1], FINE.crop - 1 - sides[..., 0], sides[..., 3]])
        flipped = mirrored(landmarks, FINE.crop, scheme)
        labels += [detections(*of) for of in zip(flipped, np.moveaxis(turned, 0, -1), strict=True)]
    options = dlib.shape_predictor_training_options()
    options.cascade_depth, options.num_trees_per_cascade_level, options.tree_depth = CASCADES, TREES, DEPTH
    options.nu, options.feature_pool_size, options.oversampling_amount = SHRINKAGE, PIXELS, OVERSAMPLING
    options.num_threads = len(os.sched_getaffinity(0))
    print(f"training dlib's shape predictor on {numbers.size} faces …", file=sys.stderr, flush=True)
    trained = dlib.train_shape_predictor(pictures, labels, options)
    unfinished = path.with_name(f".{path.name}.part")
    trained.save(str(unfinished))
    os.replace(unfinished, path)


def load_rival(path: Path, scheme: Scheme) -> Any:
    """The shape predictor in a file.

    Raises:
        InputError: there is none, or it finds other landmarks than the scheme's.
    """
    try:
        predictor = dlib.shape_predictor(str(path))
        points = predictor(np.zeros((9, 9), np.uint8), dlib.rectangle(0, 0, 8, 8)).num_parts
    except RuntimeError as error:
        raise InputError(f"--dlib-model: expected a shape predictor of dlib; {path}: {error}") from None
    if points != scheme.count:
        raise InputError(f"--dlib-model: expected one of {scheme.count} points ({scheme.name}); {path} has {points}")
    return predictor


def detections(landmarks: np.ndarray, sides: np.ndarray) -> list[Any]:
    """A face's landmarks (L, 2) as dlib takes them, for each of the rectangles (B, 4) that it may be looked for in."""
    points = [dlib.point(int(x), int(y)) for x, y in np.rint(landmarks)]
    return [dlib.full_object_detection(dlib.rectangle(*map(int, of_box)), points) for of_box in sides]


def rival_fits(predictor: Any, model: Model, faces: Sequence[FaceRecord], boxes: np.ndarray) -> np.ndarray:
    """Landmarks (N, L, 2) in the pixels of the pictures; NaN for faces that cannot be cut."""
    crops, numbers = cut_crops(model, FINE, faces, boxes)
    found = np.full((len(faces), len(faces[0].landmarks), 2), np.nan)
    sides = rectangles(crops, boxes[numbers])
    for number, crop, of_box in zip(numbers, crops.pixels, sides, strict=True):
        parts = predictor(crop, dlib.rectangle(*map(int, of_box))).parts()
        found[number] = [(point.x, point.y) for point in parts]
    found[numbers] = crops.to_images(found[numbers])
    return found


def cut_crops(model: Model, frame: Frame, faces: Sequence[FaceRecord], boxes: np.ndarray) -> tuple[Crops, np.ndarray]:
    """The crops of the faces that can be cut, as the model sees them but of another size; and the faces' numbers."""
    frame = replace(frame, shift=model.cascade.frame.shift)
    framed = replace(model, cascade=replace(model.cascade, frame=frame))
    crops, problems = jaxfit.crop_faces(framed, [face.image for face in faces], boxes, read=read_grey)
    uncut = {problem.row for problem in problems}
    numbers = np.array([number for number in range(len(faces)) if number not in uncut], int)
    return Crops(frame, *(values[numbers] for values in crops.arrays)), numbers


def rectangles(crops: Crops, boxes: np.ndarray) -> np.ndarray:
    """Boxes (N, 4) of pictures as left, top, right, bottom (N, 4) in their crops, in whole pixels as dlib wants."""
    corners = np.stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], 1)
    return np.rint(crops.from_images(corners)).astype(int).reshape(-1, 4)
