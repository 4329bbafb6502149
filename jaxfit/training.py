"""Training a model from labelled faces: pictures to crops, boxes to starts, then the cascade."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp

from jaxfit import __version__
from jaxfit.cascade.fit import ANY_ROTATION, check_rotations
from jaxfit.cascade.train import Progress, SharedAxes, Spread, TrainingSet, train_cascade
from jaxfit.data.boxes import bounding_square, box_centre, jitter
from jaxfit.data.crops import Crops, cut
from jaxfit.data.detectors import best_match, detect_faces
from jaxfit.data.images import read_grey
from jaxfit.data.placements import Placement, measure_placement
from jaxfit.data.records import FaceRecord
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.descriptors.sift import Sift
from jaxfit.exceptions import ImageError, InputError
from jaxfit.image.frame import Frame
from jaxfit.models.heads import DEFAULT_HEAD, load_head
from jaxfit.models.model import SQUARE, Model
from jaxfit.processes import by_first, exchanged, require_same, share_of
from jaxfit.shapes.asm import likely_radius
from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.points import PointSpace, mean_face
from jaxfit.shapes.schemes import Scheme, mirror_order, mirrored
from jaxfit.shapes.similarity import SimilarityASM, learn_similarity_asm
from jaxfit.shapes.space import ShapeSpace

# Faces in which detectors are run to learn how their boxes lie; profiles are rare among them, and found more rarely.
_DETECTED_FACES = 2000
_FEWEST_DETECTED = 10
# Width to length of a face below which it is a line.
_FLAT = 0.01
# How far starts of several initialisations are turned in training, as a share of the range that they cover.
_REACH = 0.7
# A box that a detector drew around a training face: the face's number, the kind of box, and the box.
_Detected = tuple[int, str, list[float]]
_SILENT: Progress = lambda stage, done, total: None  # noqa: E731


@dataclass(frozen=True)
class Options:
    """How to train.

    Attributes:
        windows: side of the descriptor window at each step, as a share of the face's side; one number a step. The
            thesis's constant, 32 pixels, is ``(32 / frame.face,) * steps``.
        augmentations: starts drawn for each face; a mirrored face counts as a face of its own.
        variance: share of the features' variance that the PCA keeps, in (0, 1].
        ridge: strength of the ridge penalty, relative to the mean variance of a kept component; 0 is least squares.
        rank: how many directions of its parameters each step is taken along, those in which what it predicts varies
            most; None: all. Fewer make a model smaller and faster.
        spread: factor on the measured spread of the starts. They are drawn around crops in which true faces scatter
            too, so that the starts of training are wider than those of fitting: better than narrower.
        initialisations: how many starts fitting shall use, one or at least three. With more than one, the starts of
            training are spread over rotations, too, so that fits from wrongly turned starts come to the face.
        rotations: in degrees, the range that the rotations of those starts cover evenly.
        shape_variance: share of the shape's variance that an Active Shape Model keeps, in (0, 1]; the thesis's is 0.95.
        sigmas: radius of the ellipsoid that an Active Shape Model's coefficients are kept in, in standard deviations.
            The thesis's is 3; but the more modes there are, the farther out faces lie, and most are cut off by 3. None
            takes the radius that holds as many of normally distributed faces as ±3 hold of normal numbers, 99.7 %.
        head: 3D shape model of the 3D methods: a bundled head model's name, or a file of ``scripts/build_head.py``.
        mirror: train on mirrored pictures too.
        haar: run OpenCV's Haar detectors on the training pictures to learn how faces lie in their boxes, which takes
            some minutes; without, the model knows only boxes around the landmarks.
        seed: of boxes and starts.
        descriptor: what is seen at a landmark; None is SIFT in windows that turn with the face, but upright ones for
            SDM from a single start.
        frame: size of the crops; None is what suits the descriptor.

    Raises:
        InputError: an option out of range.
    """

    windows: tuple[float, ...] = (0.45, 0.34, 0.26, 0.2, 0.15)
    augmentations: int = 5
    variance: float = 0.95
    ridge: float = 1.0
    rank: int | None = None
    spread: float = 1.0
    initialisations: int = 1
    rotations: tuple[float, float] = ANY_ROTATION
    shape_variance: float = 0.99
    sigmas: float | None = None
    head: str = DEFAULT_HEAD
    mirror: bool = True
    haar: bool = True
    seed: int = 0
    descriptor: Descriptor | None = None
    frame: Frame | None = None

    def __post_init__(self) -> None:
        check_rotations(self.initialisations, self.rotations)
        sigmas = 3.0 if self.sigmas is None else self.sigmas
        numbers = (*self.windows, self.variance, self.shape_variance, sigmas, self.ridge, self.spread)
        if not (
            self.windows
            and all(map(isfinite, numbers))
            and min(*self.windows, sigmas) > 0
            and self.augmentations >= 1
            and (self.rank is None or (isinstance(self.rank, int) and self.rank >= 1))
            and 0 < self.variance <= 1
            and 0 < self.shape_variance <= 1
            and min(self.ridge, self.spread, self.seed) >= 0
        ):
            raise InputError(
                "expected at least one step, windows and sigmas > 0, rank and augmentations >= 1, 0 < variance <= 1, "
                "0 < shape_variance <= 1, and ridge, spread and seed >= 0; got "
                f"windows {self.windows}, sigmas {self.sigmas}, augmentations {self.augmentations}, "
                f"rank {self.rank}, variance {self.variance}, shape_variance {self.shape_variance}, "
                f"ridge {self.ridge}, spread {self.spread}, seed {self.seed}"
            )


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


def _point_space(faces: np.ndarray, scheme: Scheme, options: Options, side: float) -> PointSpace:
    return PointSpace(jnp.asarray(mean_face(faces, side), jnp.float32))


def _similarity_asm(faces: np.ndarray, scheme: Scheme, options: Options, side: float) -> SimilarityASM:
    points = jnp.asarray(faces, jnp.float32)
    return learn_similarity_asm(points, side, options.shape_variance, options.sigmas)


def _camera_asm(faces: np.ndarray, scheme: Scheme, options: Options, side: float) -> CameraASM:
    """Pictures tell nothing of depth: the shape model is that of a head model."""
    in_cm = load_head(options.head).of(scheme, options.shape_variance)
    pixels = side / jnp.ptp(in_cm.mean[:, :2], 0).max()
    model = in_cm.scaled(pixels)
    sigmas = likely_radius(len(model.deviations)) if options.sigmas is None else options.sigmas
    return CameraASM(model, jnp.float32(sigmas))


@dataclass(frozen=True)
class Method:
    """What makes a method.

    Attributes:
        learn_space: learns the shape space from faces (N, L, 2) of a scheme, given in units of their bounding squares;
            the last argument is the side of the canonical face, in pixels.
        descriptor: what is seen at a landmark unless told otherwise.
        in_3d: whether it finds the face in 3D.
    """

    learn_space: Callable[[np.ndarray, Scheme, Options, float], ShapeSpace]
    descriptor: Descriptor
    in_3d: bool = False

    @property
    def aligns(self) -> bool:
        """Whether a 3D shape model is aligned to the landmarks of a 2D one."""
        return self.in_3d and self.learn_space is not _camera_asm


METHODS = {
    "sdm": Method(_point_space, Sift("upright")),
    "parametric": Method(_similarity_asm, Sift("face")),
    "alignment3d": Method(_similarity_asm, Sift("face"), in_3d=True),
    "regression3d": Method(_camera_asm, Sift("face"), in_3d=True),
}


def train(
    faces: Sequence[FaceRecord],
    scheme: Scheme,
    *,
    method: str = "sdm",
    options: Options | None = None,
    progress: Progress = _SILENT,
    read: Callable[[Path], np.ndarray] = read_grey,
    axes: SharedAxes | None = None,
) -> Trained:
    """Train a model on labelled faces; those with missing landmarks or unreadable pictures are left out and reported.

    Processes that are joined (``jaxfit.join_processes``) learn one model together, which each gets: each reads the
    pictures of its own share of the faces, but needs the labels of all.

    Args:
        faces: the labelled faces, all of one scheme.
        scheme: what their landmarks mean.
        method: one of ``METHODS``: ``"sdm"`` is the Supervised Descent Method, ``"parametric"`` the same on the
            parameters of an Active Shape Model, ``"alignment3d"`` aligns a 3D one to what that finds, and
            ``"regression3d"`` is the cascade on the parameters of a 3D one and its camera.
        options: how to train; None for the defaults.
        progress: called with a stage's name, what is done and what there is to do.
        read: gets a picture's path and returns it grey, uint8 (H, W); ``GreyPictures()`` remembers them.
        axes: what trainings of this method on the same faces share that differ in nothing but the windows, ridge,
            variance or spread, as `choose_options` tries them.

    Raises:
        InputError: an unknown method, an option out of range, fewer than two usable faces, or processes that were not
            told the same, or one without any readable picture.
        ProcessError: another of the processes ended.
    """
    options = options or Options()
    if method not in METHODS:
        raise InputError(f"expected a method among {', '.join(METHODS)}; got {method!r}")
    if other := next((face for face in faces if len(face.landmarks) != scheme.count), None):
        raise InputError(f"expected faces of {scheme.count} landmarks ({scheme.name}); {other.image} has others")
    complete, problems = usable_faces(faces, scheme)
    if scheme.count == 0:
        raise InputError("expected faces with landmarks to learn from; these have none, such as Pointing'04's")
    if len(complete) < 2:
        raise InputError(f"expected at least two faces with all {scheme.count} landmarks; got {len(complete)}")
    descriptor, frame = seen(method, options)
    if options.mirror:
        mirror_order(scheme)
    # A head model without these landmarks stops before the work.
    solid = _camera_asm(np.empty(0), scheme, options, frame.face) if METHODS[method].in_3d else None
    landmarks = np.stack([face.landmarks for face in complete])
    require_same(method, options, scheme.name, [face.face for face in complete], landmarks)
    squares = np.stack([bounding_square(points) for points in landmarks])
    relative = (landmarks - squares[:, None, :2]) / squares[:, None, 2:]
    mean = mean_face(relative, frame.face)
    rng = np.random.default_rng(options.seed)
    jittered = np.stack([jitter(square, rng) for square in squares])
    placement = measure_placement(jittered, landmarks, mean, frame.face)

    mine = share_of([face.image for face in complete])
    detected: list[_Detected] = []
    every = max(1, len(complete) // _DETECTED_FACES)

    def look(row: int, grey: np.ndarray) -> None:
        number = int(mine[row])
        if options.haar and number % every == 0 and (match := best_match(detect_faces(grey), squares[number])):
            detected.append((number, match.kind, match.box.tolist()))

    own = [complete[number] for number in mine]
    crops, rows, why = cut_faces(own, squares[mine], placement, frame, read, progress, look)
    unread = list(zip(np.setdiff1d(mine, mine[rows]).tolist(), why, strict=True))
    parts = exchanged([unread, detected, len(rows)])
    problems += [why for _, why in sorted(each for part in parts for each in part[0])]
    readable = np.setdiff1d(np.arange(len(complete)), [number for part in parts for number, _ in part[0]])
    if len(readable) < 2:
        raise InputError(f"expected at least two readable pictures; got {len(readable)}: {'; '.join(problems[:3])}")
    if idle := [process for process, part in enumerate(parts) if part[2] == 0]:
        raise InputError(f"expected readable pictures for each process, but {idle} have none: use fewer processes")
    numbers, count = np.searchsorted(readable, mine[rows]), len(readable)
    if options.mirror:
        numbers, count = np.concatenate([numbers, numbers + count]), 2 * count
    learned = training_set(crops, landmarks[mine], squares[mine], rows, scheme if options.mirror else None)
    space = METHODS[method].learn_space(relative[readable], scheme, options, frame.face)
    space = jax.tree.unflatten(jax.tree.structure(space), by_first(lambda: space))
    cascade = train_cascade(
        space,
        descriptor,
        frame,
        replace(learned, numbers=numbers, of=count),
        _scaled(placement.spread, options.spread),
        windows=options.windows,
        augmentations=options.augmentations,
        variance=options.variance,
        ridge=options.ridge,
        rank=options.rank,
        seed=options.seed,
        turn=start_turn(options.initialisations, options.rotations),
        axes=axes,
        progress=progress,
    )
    head = solid if METHODS[method].aligns else None
    in_boxes = _detected_placements(sorted(each for part in parts for each in part[1]), landmarks, mean, frame.face)
    return Trained(
        Model(cascade, scheme, {SQUARE: placement, **in_boxes}, _summary(method, options, len(readable)), head),
        len(readable),
        tuple(problems),
    )


def default_descriptor(method: str, initialisations: int) -> Descriptor:
    """What is seen at a landmark unless told otherwise: with several initialisations, windows turn with the face."""
    return METHODS[method].descriptor if initialisations == 1 else Sift("face")


def seen(method: str, options: Options) -> tuple[Descriptor, Frame]:
    """What a method sees at a landmark, and the size of its crops, with these options."""
    descriptor = options.descriptor or default_descriptor(method, options.initialisations)
    return descriptor, options.frame or descriptor.frame


def start_turn(initialisations: int, rotations: Sequence[float]) -> float:
    """By how much starts are turned in training, at most, in radians, for `Options` with these.

    The fits of most starts must come to the face wherever in the range it lies, lest their centroid be elsewhere.
    Reaching over half the range would do, if all fits from within reach succeeded.
    """
    low, high = rotations
    return 0.0 if initialisations == 1 else min(float(np.radians(_REACH * (high - low))), np.pi)


def usable_faces(faces: Sequence[FaceRecord], scheme: Scheme) -> tuple[list[FaceRecord], list[str]]:
    """The faces to learn from, and what is wrong with the others."""
    complete = [face for face in faces if face.complete]
    problems = []
    if left_out := len(faces) - len(complete):
        problems.append(f"{left_out} of {len(faces)} faces left out: not all {scheme.count} landmarks are annotated")
    flat = [_on_a_line(face.landmarks) for face in complete]
    problems += [
        f"{face.image}: all landmarks lie on a line" for face, of_face in zip(complete, flat, strict=True) if of_face
    ]
    return [face for face, of_face in zip(complete, flat, strict=True) if not of_face], problems


def _on_a_line(points: np.ndarray) -> bool:
    """Whether points (L, 2) lie on a line or in one point: they are no face, and tell no pose."""
    across, along = np.linalg.eigvalsh(np.cov(points.T))
    return bool(across <= _FLAT**2 * along)


def cut_faces(
    faces: Sequence[FaceRecord],
    squares: np.ndarray,
    placement: Placement,
    frame: Frame,
    read: Callable[[Path], np.ndarray],
    progress: Progress,
    look: Callable[[int, np.ndarray], None] = lambda number, grey: None,
) -> tuple[Crops, np.ndarray, list[str]]:
    """The crops of faces in squares (N, 4), which of them could be read (M,), and why others could not.

    ``look`` is shown the number and the grey picture of each face.
    """
    crops = Crops.empty(len(faces), frame)
    rows, problems = [], []
    for number, face in enumerate(faces):
        progress("reading pictures", number, len(faces))
        try:
            grey = read(face.image)
        except ImageError as error:
            problems.append(str(error))
            continue
        rows.append(number)
        cut(grey, *placement.face_in(squares[number]), crops, number)
        look(number, grey)
    progress("reading pictures", len(faces), len(faces))
    return crops, np.array(rows, int), problems


def training_set(
    crops: Crops, landmarks: np.ndarray, squares: np.ndarray, rows: np.ndarray, mirror: Scheme | None
) -> TrainingSet:
    """The faces in crop pixels; with ``mirror``, each a second time, flipped."""
    points = crops.from_images(landmarks[rows], rows)
    pivots = crops.from_images(np.stack([box_centre(square) for square in squares[rows]])[:, None], rows)[:, 0]
    flips = np.zeros(len(rows), bool)
    if mirror is not None:
        width = crops.pixels.shape[2]
        points, rows = np.concatenate([points, mirrored(points, width, mirror)]), np.concatenate([rows, rows])
        pivots = np.concatenate([pivots, [width - 1, 0] + pivots * [-1, 1]])
        flips = np.concatenate([flips, ~flips])
    return TrainingSet(crops.pixels, points.astype(np.float32), flips, rows, pivots.astype(np.float32))


def _detected_placements(
    detected: Sequence[_Detected], landmarks: np.ndarray, mean: np.ndarray, face: float
) -> dict[str, Placement]:
    """How faces lie in the boxes of each kind of which there are enough."""
    placements = {}
    for kind in sorted({kind for _, kind, _ in detected}):
        found = [(number, box) for number, of_kind, box in detected if of_kind == kind]
        if len(found) >= _FEWEST_DETECTED:
            boxes, labels = np.array([box for _, box in found]), landmarks[[number for number, _ in found]]
            placements[kind] = measure_placement(boxes, labels, mean, face)
    return placements


def _scaled(spread: Spread, factor: float) -> Spread:
    return Spread(
        (spread.shift[0] * factor, spread.shift[1] * factor),
        spread.log_scale * factor,
        spread.rotation * factor,
    )


def _summary(method: str, options: Options, faces: int) -> dict[str, Any]:
    """What a model file says about its making; plain JSON values."""
    told_elsewhere = ("descriptor", "frame", "haar", "head")
    made = {key: value for key, value in asdict(options).items() if key not in told_elsewhere}
    lists = {"windows": list(options.windows), "rotations": list(options.rotations)}
    # Not the path of a file: where it lay is nobody else's business.
    head = {}
    if METHODS[method].in_3d:
        head = {"head": Path(options.head).name, "head_source": load_head(options.head).source}
    return {"jaxfit": __version__, "method": method, "faces": faces, **made, **lists, **head}
