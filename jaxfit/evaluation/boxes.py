"""Boxes that labelled faces are fitted from: beside their labels, where a detector finds them, or from a file."""

import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxfit.data.boxes import UNKNOWN_BOX, GivenBox, bounding_square, box_centre, boxes_of_pictures, jitter
from jaxfit.data.detectors import Detection, Detector, best_match
from jaxfit.data.detectors.whole import KIND as WHOLE
from jaxfit.errors import InputError
from jaxfit.fitting.find import find_faces
from jaxfit.labels.records import FaceRecord
from jaxfit.models.model import SQUARE
from jaxfit.processes import exchanged, share_of
from jaxfit.types import Progress, silent


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
        own = UNKNOWN_BOX if face.box is None else face.box
        boxes.append(jitter(bounding_square(face.landmarks), rng) if face.present.any() else own)
    return np.array(boxes).reshape(-1, 4)


def detected_boxes(
    faces: Sequence[FaceRecord],
    detector: str | Detector,
    *,
    progress: Progress = silent,
) -> tuple[np.ndarray, list[str], np.ndarray]:
    """The boxes (N, 4) in which a detector finds labelled faces, their kinds, and their rotations (N,) in degrees; NaN,
    squares and 0 where it does not.

    Processes that are joined share the pictures, as in `evaluate`.

    Args:
        faces: N labelled faces with landmarks.
        detector: as in ``jaxfit.detect_faces``; ``jaxfit.data.detector_named`` makes one that looks otherwise.
        progress: called with the stage's name, pictures done and pictures in all.

    Raises:
        InputError: there is no such detector.
    """
    pictures = {picture: number for number, picture in enumerate(dict.fromkeys(face.image for face in faces))}
    names = list(pictures)
    own = share_of(names)
    found = find_faces([names[number] for number in own], detector, progress=progress)
    in_pictures: list[list[Detection]] = [[] for _ in pictures]
    found_here = [own[found.pictures].tolist(), found.boxes.tolist(), found.kinds, found.rotations.tolist()]
    for part in exchanged(found_here):
        for picture, box, kind, rotation in zip(*part, strict=True):
            in_pictures[picture].append(Detection(np.array(box), kind, rotation))
    rotations = np.zeros(len(faces))
    boxes, kinds = np.tile(UNKNOWN_BOX, (len(faces), 1)), [SQUARE] * len(faces)
    for number, face in enumerate(faces):
        if not face.present.any():
            continue
        candidates, truth = in_pictures[pictures[face.image]], bounding_square(face.landmarks)
        whole = [candidate for candidate in candidates if candidate.kind == WHOLE]  # found wherever the face is
        if match := next(iter(whole), None) or best_match(candidates, truth):
            boxes[number], kinds[number], rotations[number] = match.box, match.kind, match.rotation
    return boxes, kinds, rotations


def match_boxes(
    faces: Sequence[FaceRecord],
    named: Mapping[str, Sequence[GivenBox]],
    folders: Iterable[str | Path] = (),
) -> tuple[np.ndarray, list[str], np.ndarray]:
    """Boxes (N, 4) of labelled faces, their kinds, and their rotations (N,) in degrees, from those that a file gives;
    each box goes to one face at most, the nearest pairs first.

    NaN, squares and 0 where none is left for a face: it counts as undetected.

    Args:
        faces: N labelled faces.
        named: boxes by what the file calls their picture, as ``jaxfit.data.read_boxes`` reads them.
        folders: that paths in the file may be relative to.

    Raises:
        InputError: a name may mean several pictures.
    """
    return share_boxes(faces, boxes_of_pictures(named, [face.image for face in faces], folders)[0])


def share_boxes(
    faces: Sequence[FaceRecord], of_pictures: Mapping[Path, Sequence[GivenBox]]
) -> tuple[np.ndarray, list[str], np.ndarray]:
    """What `match_boxes` gives, from the boxes of each picture."""
    boxes, rotations = np.tile(UNKNOWN_BOX, (len(faces), 1)), np.zeros(len(faces))
    kinds = [SQUARE] * len(faces)
    pictures: dict[Path, list[int]] = {}
    for number, face in enumerate(faces):
        pictures.setdefault(face.image, []).append(number)
    for picture, numbers in pictures.items():
        given = list(of_pictures.get(picture, []))
        pairs = sorted((_distance(faces[n], each.box), n, k) for n in numbers for k, each in enumerate(given))
        used: set[int] = set()
        for _, number, k in pairs:
            if k not in used and np.isnan(boxes[number]).all():
                boxes[number], rotations[number], kind = given[k]
                kinds[number] = kind or SQUARE
                used.add(k)
    return boxes, kinds, rotations


def _distance(face: FaceRecord, box: np.ndarray) -> float:
    if not face.present.any():
        return 0.0
    return float(np.hypot(*(box_centre(box) - box_centre(bounding_square(face.landmarks)))))
