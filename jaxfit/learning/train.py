"""Training a model from labelled faces: pictures to crops, boxes to starts, then the cascade."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxfit import __version__
from jaxfit.cascade.greedy import SharedAxes, train_cascade, with_copies
from jaxfit.data.boxes import bounding_square, jitter
from jaxfit.data.detectors import best_match, detector_named
from jaxfit.data.detectors.whole import KIND as WHOLE
from jaxfit.data.pictures import Read, read_grey
from jaxfit.errors import InputError
from jaxfit.heads.model import load_head_model
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.methods import Options, camera_asm, method_named, view_of
from jaxfit.learning.prepare import cut_labelled, training_set, usable_faces
from jaxfit.models.digests import digest_set
from jaxfit.models.model import SQUARE, Model
from jaxfit.models.placements import Placement, measure_placement, placements_of
from jaxfit.modes import computing
from jaxfit.processes import by_first, exchanged, require_same, share_of
from jaxfit.schemes.scheme import Scheme, mirror_order
from jaxfit.shapes.points import mean_face
from jaxfit.types import Progress, silent

# Faces in which detectors are run to learn how their boxes lie; profiles are rare among them, and found more rarely.
_DETECTED_FACES = 2000
_FEWEST_DETECTED, _FEWEST_WHOLE = 10, 5  # boxes of a kind, to learn how faces lie in it
_DETECTORS = ("yunet", "haar")
# A box that a detector drew around a training face: the face's number, the kind of box, the box, and its rotation.
_Detected = tuple[int, str, list[float], float]


@dataclass(frozen=True)
class Trained:
    """What training gives.

    Attributes:
        model: the model.
        faces: number of faces it learned from, mirrored ones not counted.
        problems: what was left out and why, a sentence each.
    """

    model: Model
    faces: int
    problems: tuple[str, ...]


@computing
def train(
    faces: Sequence[FaceRecord],
    scheme: Scheme,
    *,
    method: str = "sdm",
    options: Options = Options(),
    progress: Progress = silent,
    read: Read = read_grey,
    axes: SharedAxes | None = None,
) -> Trained:
    """Train a model on labelled faces; those with missing landmarks or unreadable pictures are left out and reported.

    Processes that are joined (``jaxfit.learning.join_processes``) learn one model together, which each gets: each reads
    the pictures of its own share of the faces, but needs the labels of all.

    Args:
        faces: the labelled faces, all of one scheme.
        scheme: what their landmarks mean.
        method: one of ``METHODS``: ``"sdm"`` is the Supervised Descent Method, ``"parametric"`` the same on the
            parameters of an Active Shape Model, ``"alignment3d"`` aligns a 3D one to what that finds, and
            ``"regression3d"`` is the cascade on the parameters of a 3D one and its camera.
        options: how to train.
        progress: called with a stage's name, what is done and what there is to do.
        read: gets a picture's path and returns it grey, uint8 (H, W); ``GreyPictures()`` remembers them.
        axes: what trainings of this method on the same faces share that differ in nothing but the windows, ridge,
            variance or spread, as `choose_options` tries them.

    Raises:
        InputError: an unknown method, fewer than two usable faces, or joined processes that have other faces or
            options, or one of them no readable picture.
        ProcessError: another of the processes ended.
    """
    kind, seed = method_named(method), options.greedy.seed
    complete, problems = _learnable(faces, scheme, method)
    descriptor, frame = view_of(method, options)
    if options.mirror:
        mirror_order(scheme)
    # A head model without these landmarks stops before the work.
    space_3d = camera_asm(np.empty(0), scheme, options, frame.face) if kind.in_3d else None
    landmarks = np.stack([face.landmarks for face in complete])
    require_same(method, options, scheme.name, [face.face for face in complete], landmarks)
    squares = np.stack([bounding_square(points) for points in landmarks])
    relative = (landmarks - squares[:, None, :2]) / squares[:, None, 2:]
    mean = mean_face(relative, frame.face)
    rng = np.random.default_rng(seed)
    jittered = np.stack([jitter(square, rng) for square in squares])
    placement = measure_placement(jittered, landmarks, mean, frame.face)

    share = share_of([face.image for face in complete])
    detected: list[_Detected] = []
    every = max(1, len(complete) // _DETECTED_FACES)
    detectors = [detector_named(name) for name in _DETECTORS] if options.detectors else []

    alone = Counter(face.image for face in complete)
    own_kind = not placements_of(scheme.name)  # how faces lie in whole pictures is known of others

    def look(row: int, grey: np.ndarray) -> None:
        number = int(share[row])
        if own_kind and alone[complete[number].image] == 1:
            height, width = grey.shape
            detected.append((number, WHOLE, [0.0, 0.0, float(width), float(height)], 0.0))
        for detector in detectors if number % every == 0 else ():
            if match := best_match(detector(grey), squares[number]):
                detected.append((number, match.kind, match.box.tolist(), match.rotation))

    own = [complete[number] for number in share]
    crops, rows, why, digests = cut_labelled(own, squares[share], placement, frame, read, progress, look)
    unread = list(zip(np.setdiff1d(share, share[rows]).tolist(), why, strict=True))
    parts = exchanged([unread, detected, len(rows), digests])
    problems += [why for _, why in sorted(each for part in parts for each in part[0])]
    readable = np.setdiff1d(np.arange(len(complete)), [number for part in parts for number, _ in part[0]])
    if len(readable) < 2:
        raise InputError(f"expected at least two readable pictures; got {len(readable)}: {'; '.join(problems[:3])}")
    if idle := [process for process, part in enumerate(parts) if part[2] == 0]:
        raise InputError(f"expected readable pictures for each process, but {idle} have none: use fewer processes")
    numbers, count = np.searchsorted(readable, share[rows]), len(readable)
    if options.mirror:
        numbers, count = np.concatenate([numbers, numbers + count]), 2 * count
    learned = training_set(crops, landmarks[share], squares[share], rows, scheme if options.mirror else None)
    space = kind.learn_space(relative[readable], scheme, options, frame.face)
    space = jax.tree.unflatten(jax.tree.structure(space), by_first(lambda: space))
    cascade = train_cascade(
        space,
        descriptor,
        frame,
        with_copies(replace(learned, numbers=numbers, of=count), options.greedy.copies, seed),
        placement.spread,
        options.greedy,
        turn=options.starts.turn,
        axes=axes,
        progress=progress,
    )
    in_boxes = _detected_placements(sorted(each for part in parts for each in part[1]), landmarks, mean, frame.face)
    return Trained(
        Model(
            cascade,
            scheme,
            {SQUARE: placement, **in_boxes},
            _summary(method, options, len(readable)),
            aligned=space_3d if kind.aligns else None,
            learned=digest_set(digest for part in parts for digest in part[3]),
        ),
        len(readable),
        tuple(problems),
    )


def _learnable(faces: Sequence[FaceRecord], scheme: Scheme, method: str) -> tuple[list[FaceRecord], list[str]]:
    """The faces that can be learned from, and what is wrong with the others.

    Raises:
        InputError: faces of another number of landmarks, too few landmarks for the method, or too few faces.
    """
    fewest = method_named(method).fewest
    if other := next((face for face in faces if len(face.landmarks) != scheme.count), None):
        raise InputError(f"expected faces of {scheme.count} landmarks ({scheme.name}); {other.image} has others")
    if scheme.count == 0:
        raise InputError("expected faces with landmarks to learn from; these have none, such as Pointing'04's")
    if scheme.count < fewest:
        raise InputError(
            f"expected at least {fewest} landmarks for the method {method!r}, which has to learn size and shape "
            f"from them; {scheme.name} has {scheme.count}: label more, or take another method"
        )
    complete, problems = usable_faces(faces, scheme)
    if len(complete) < 2:
        raise InputError(
            f"expected at least two faces with all {scheme.count} landmarks; got {len(complete)} of {len(faces)}: "
            f"{'; '.join(problems[:3])}"
        )
    return complete, problems


def _detected_placements(
    detected: Sequence[_Detected], landmarks: np.ndarray, mean: np.ndarray, face: float
) -> dict[str, Placement]:
    """How faces lie in the boxes of each kind of which there are enough."""
    placements = {}
    for kind in sorted({kind for _, kind, _, _ in detected}):
        found = [(number, box, rotation) for number, of_kind, box, rotation in detected if of_kind == kind]
        if len(found) >= (_FEWEST_WHOLE if kind == WHOLE else _FEWEST_DETECTED):
            numbers, boxes, rotations = map(np.array, zip(*found, strict=True))
            placements[kind] = measure_placement(boxes, landmarks[numbers], mean, face, rotations)
    return placements


def _summary(method: str, options: Options, faces: int) -> dict[str, Any]:
    """What a model file says about its making; plain JSON values."""
    greedy, starts = options.greedy, options.starts
    summary: dict[str, Any] = vars(greedy) | {"windows": list(greedy.windows)}
    summary |= {"initialisations": starts.count, "rotations": [starts.low, starts.high]}
    summary |= {"shape_variance": options.shape_variance, "sigmas": options.sigmas, "mirror": options.mirror}
    if method_named(method).in_3d:
        # Not the path of a file: where it lay is nobody else's business.
        head_model = load_head_model(options.head_model)
        summary |= {"head": Path(options.head_model).name, "head_source": head_model.source}
    return {"jaxfit": __version__, "method": method, "faces": faces, **summary}
