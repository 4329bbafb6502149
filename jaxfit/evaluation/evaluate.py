"""Measuring a model on labelled faces in boxes: fits and errors; every face is accounted for."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaxfit.cascade.model import first_steps
from jaxfit.cascade.starts import Starts
from jaxfit.data.boxes import rotation_array
from jaxfit.data.pictures import Read, read_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.errors import nmed
from jaxfit.fitting.batches import batches_of, compile_batches
from jaxfit.fitting.fit import fits_of_sources, sources_of
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.fitting.pipeline import Fitting, Pipeline
from jaxfit.labels.aligned import with_depth
from jaxfit.labels.records import FaceRecord
from jaxfit.models.digests import DigestingReader
from jaxfit.models.model import SQUARE, Model
from jaxfit.processes import exchanged, gathered, require_same, share_of
from jaxfit.schemes.conversions import convert, sources
from jaxfit.schemes.normalisers import annotated, default_normaliser, distance, normaliser_length
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.pose_order import in_order
from jaxfit.types import Progress, silent

_WIDE = 45.0  # degrees of yaw: of a head that is turned further, the outer eye corners come together


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Fits of N labelled faces and their errors.

    Attributes:
        faces: the N faces.
        fits: of each, a row; NaN where there is none.
        scheme: what the landmarks mean in which errors are measured.
        normaliser: what the errors are relative to: one of ``NORMALISERS``.
        errors: (N,) NMED (Eq. 16); ``inf`` where there is no fit, NaN where the truth does not allow to measure.
        errors_3d: (N,) NMED in 3D, against labels with the depths of the model's own 3D shapes (thesis 4.2); NaN if
            the errors are not measured on the model's own landmarks; None for 2D models.
        seconds_per_face: time of reading, cropping and fitting, after compilation, until the last process is done; NaN
            if nothing was fitted.
        learned: (N,) bool, whether the model learned from each face's picture; None: it does not say.
    """

    faces: tuple[FaceRecord, ...]
    fits: Fits
    scheme: Scheme
    normaliser: str
    errors: np.ndarray
    errors_3d: np.ndarray | None = None
    seconds_per_face: float = float("nan")
    learned: np.ndarray | None = None

    @property
    def landmarks(self) -> np.ndarray:
        """(N, L, 2) the fitted landmarks in the scheme that errors are measured in, in pixels; NaN without a fit."""
        return convert(self.fits.landmarks, self.fits.scheme, self.scheme)

    @property
    def distances(self) -> np.ndarray:
        """(N, L) distances of fitted landmarks from the true ones, in pixels; NaN without a fit or annotation."""
        return distance(self.landmarks, annotated(_truth(self.faces, self.scheme)))

    @property
    def true_pose(self) -> np.ndarray:
        """(N, 3) labelled roll, pitch and yaw in degrees, NaN where unknown; each face's in its own order."""
        return np.array([[np.nan] * 3 if face.pose is None else face.pose for face in self.faces]).reshape(-1, 3)

    @property
    def ordered_pose(self) -> np.ndarray:
        """(N, 3) the fits' poses in the orders of the labelled ones, to be compared with them; NaN for 2D models."""
        poses = np.full((len(self.faces), 3), np.nan) if self.fits.pose is None else self.fits.pose
        return in_order(poses, [face.pose_order for face in self.faces])

    @classmethod
    def join(cls, parts: Sequence["Evaluation"]) -> "Evaluation":
        """Evaluations of one model on several sets of faces as one.

        Raises:
            InputError: no parts, or of different models.
        """
        fits = Fits.join([part.fits for part in parts])
        fitted = np.array([part.fits.fitted.sum() for part in parts])
        seconds = sum(count * part.seconds_per_face for count, part in zip(fitted, parts, strict=True) if count)
        errors_3d = [part.errors_3d for part in parts if part.errors_3d is not None]
        learned = [part.learned for part in parts if part.learned is not None]
        return replace(
            parts[0],
            faces=sum((part.faces for part in parts), ()),
            fits=fits,
            errors=np.concatenate([part.errors for part in parts]),
            errors_3d=np.concatenate(errors_3d) if errors_3d else None,
            learned=np.concatenate(learned) if len(learned) == len(parts) else None,
            seconds_per_face=float(seconds / fitted.sum()) if fitted.sum() else float("nan"),
        )


def evaluate(
    model: Model,
    faces: Sequence[FaceRecord],
    boxes: np.ndarray,
    *,
    kind: str | Sequence[str] = SQUARE,
    rotations: np.ndarray | None = None,
    scheme: Scheme | None = None,
    normaliser: str | None = None,
    starts: Starts = Starts(),
    passes: int | None = None,
    read: Read = read_grey,
    progress: Progress = silent,
) -> Evaluation:
    """Fit labelled faces from given boxes and measure the errors: `fit_labelled`, then `measure`.

    Processes that are joined (``jaxfit.learning.join_processes``) share the pictures, and get the results of all.

    Args:
        model: the model.
        faces: N labelled faces.
        boxes: (N, 4) x, y, width, height in pixels; a NaN box is an undetected face: a failure.
        kind: what drew the boxes, as in ``jaxfit.fit``: one for all, or N.
        rotations: (N,) how far the faces are turned, as in ``jaxfit.fit``.
        scheme: what the labels mean, if not what the model's landmarks do: fits are converted to it.
        normaliser: ``"outer"`` eye corners, ``"pupil"`` centres or bounding ``"box"`` side; None takes
            `usual_normaliser`.
        starts: of each face, as in ``jaxfit.fit``.
        passes: as in ``jaxfit.fit``.
        read: gets a picture's path and returns it grey, uint8 (H, W); it is called in threads.
        progress: called with the stage's name, faces done and faces in all.

    Raises:
        InputError: labels of another number of landmarks, a scheme that fits cannot be converted to, boxes of another
            number, an unknown normaliser or kind, no passes, or processes that do not have the same.
        ProcessError: another of the processes ended.
    """
    require_measurable(model.scheme, scheme or model.scheme, normaliser, faces)
    pipeline = Fitting(starts=starts, passes=passes).pipeline_in_boxes(model, read=read)
    fits, seconds, learned = fit_labelled(pipeline, faces, boxes, kind=kind, rotations=rotations, progress=progress)
    how: dict[str, Any] = {"seconds_per_face": seconds, "learned": learned}
    return measure(fits, faces, scheme=scheme, normaliser=normaliser, model=model, **how)


def evaluate_steps(
    model: Model,
    faces: Sequence[FaceRecord],
    boxes: np.ndarray,
    *,
    normaliser: str | None = None,
    read: Read = read_grey,
    progress: Progress = silent,
) -> list[Evaluation]:
    """What `evaluate` gives, with the same arguments, for the model's first step alone, its first two, and so on."""
    counts = range(1, len(model.cascade.weights) + 1)
    models = [replace(model, cascade=first_steps(model.cascade, count), confidence=None) for count in counts]
    return [evaluate(each, faces, boxes, normaliser=normaliser, read=read, progress=progress) for each in models]


def usual_normaliser(scheme: Scheme, faces: Sequence[FaceRecord]) -> str:
    """What errors of labelled faces are divided by, unless a normaliser is given.

    The outer eye corners, if the scheme has them; the bounding square if it has not, or if some of the faces are turned
    by over 45°, where the eye corners come together.
    """
    wide = any(face.pose is not None and abs(face.pose[2]) > _WIDE for face in faces)
    return "box" if wide else default_normaliser(scheme)


def require_measurable(own: Scheme, scheme: Scheme, normaliser: str | None, faces: Sequence[FaceRecord]) -> None:
    """Check, before the work, that errors of fits can be measured.

    Args:
        own: what the fits' landmarks mean.
        scheme: what the labels mean.
        normaliser: what errors are relative to; None: `usual_normaliser`.
        faces: the labelled faces.

    Raises:
        InputError: a scheme that fits cannot be converted to, an unknown normaliser, or labels of another number of
            landmarks.
    """
    sources(own, scheme)
    require_scheme(scheme, faces)
    normaliser_length(np.empty((0, scheme.count, 2)), scheme, normaliser or usual_normaliser(scheme, faces))


def fit_labelled(
    pipeline: Pipeline,
    faces: Sequence[FaceRecord],
    boxes: np.ndarray,
    *,
    kind: str | Sequence[str] = SQUARE,
    rotations: np.ndarray | None = None,
    progress: Progress = silent,
) -> tuple[Fits, float, np.ndarray | None]:
    """The fits of labelled faces, a row each, the seconds that a face took, and (N,) bool, which pictures the model
    learned from, None if it does not say; joined processes share the pictures.

    Args:
        pipeline: how they are fitted, compiled before the time is taken.
        faces: N labelled faces.
        boxes: (N, 4) in pixels; NaN where there is none.
        kind: what drew the boxes: one for all, or N.
        rotations: (N,) how far the faces are turned, in degrees, clockwise as seen; None: not at all.
        progress: called with the stage's name, faces done and faces in all.

    Raises:
        InputError: boxes of another number, an unknown kind, or processes that do not have the same.
        ProcessError: another of the processes ended.
    """
    model, boxes = pipeline.model, np.asarray(boxes, np.float64)
    if boxes.shape != (len(faces), 4):
        raise InputError(f"expected one box for each of {len(faces)} faces, ({len(faces)}, 4); got {boxes.shape}")
    kinds, turned = [kind] * len(faces) if isinstance(kind, str) else list(kind), rotation_array(rotations, len(faces))
    if len(kinds) != len(faces):
        raise InputError(f"expected one kind of box, or one for each of {len(faces)} faces; got {len(kinds)}")
    for each in {*kinds}:
        model.placement(each)
    require_same(model.cascade, model.aligned, model.scheme.name, [face.face for face in faces], boxes)
    boxed = np.isfinite(boxes).all(1)
    share = share_of([face.image for face in faces])
    if own := int(boxed[share].sum()):
        progress("compiling (cached for later runs)", 0, len(faces))
        compile_batches(pipeline, list(dict.fromkeys(batches_of(own))))
    reader = DigestingReader(pipeline.read or read_grey)
    if model.learned is not None:
        pipeline = replace(pipeline, read=reader)
    begin = time.perf_counter()
    sources_ = sources_of(
        model, [faces[row].image for row in share], boxes[share], [kinds[row] for row in share], turned[share]
    )
    fits = fits_of_sources(pipeline, sources_, progress)
    seconds = max(exchanged(time.perf_counter() - begin))
    learned = None
    if (digests := model.learned) is not None:
        learned = gathered(reader.among([faces[row].image for row in share], digests), share, len(faces))
    return _of_all(fits, share, faces, kinds), seconds / boxed.sum() if boxed.any() else float("nan"), learned


def _of_all(fits: Fits, share: np.ndarray, faces: Sequence[FaceRecord], kinds: Sequence[str]) -> Fits:
    """The fits of all processes, of which this one made those of the faces numbered ``share``."""
    own = [[int(share[problem.picture]), problem.why] for problem in fits.problems]
    problems = sorted((row, why) for part in exchanged(own) for row, why in part)
    whole: dict[str, Any] = {name: gathered(values, share, len(faces)) for name, values in fits.arrays.items()}
    return replace(
        fits,
        names=tuple(str(face.image) for face in faces),
        sizes=gathered(fits.sizes, share, len(faces)),
        kinds=tuple(kinds),
        problems=tuple(Problem(row, str(faces[row].image), why, row) for row, why in problems),
        **whole | {"pictures": np.arange(len(faces))},
    )


def measure(
    fits: Fits,
    faces: Sequence[FaceRecord],
    *,
    scheme: Scheme | None = None,
    normaliser: str | None = None,
    model: Model | None = None,
    seconds_per_face: float = float("nan"),
    learned: np.ndarray | None = None,
) -> Evaluation:
    """The errors of fits of labelled faces.

    Args:
        fits: a row for each of N faces.
        faces: the N labelled faces.
        scheme: what the labels mean; None: what the fits' landmarks do.
        normaliser: as in `evaluate`.
        model: what made the fits: its 3D shapes give the labels their depths. None: nothing is measured in 3D.
        seconds_per_face: that fitting took.
        learned: (N,) bool, from whose pictures the model learned, as `fit_labelled` says; None: unknown.

    Raises:
        InputError: another number of faces, labels of another number of landmarks, a scheme that fits cannot be
            converted to, or an unknown normaliser.
    """
    scheme = scheme or fits.scheme
    normaliser = normaliser or usual_normaliser(scheme, faces)
    require_measurable(fits.scheme, scheme, normaliser, faces)
    if len(fits) != len(faces):
        raise InputError(f"expected a fit for each of {len(faces)} faces; got {len(fits)}")
    truth = _truth(faces, scheme)
    errors_3d = None
    if fits.landmarks_3d is not None:
        found = convert(fits.landmarks_3d, fits.scheme, scheme)
        errors_3d = nmed(found, _truth_3d(model, scheme, truth), scheme, normaliser)
    return Evaluation(
        faces=tuple(faces),
        fits=fits,
        scheme=scheme,
        normaliser=normaliser,
        errors=nmed(convert(fits.landmarks, fits.scheme, scheme), truth, scheme, normaliser),
        errors_3d=errors_3d,
        seconds_per_face=seconds_per_face,
        learned=learned,
    )


def _truth(faces: Sequence[FaceRecord], scheme: Scheme) -> np.ndarray:
    """The labels (N, L, 2); NaN of faces without landmarks."""
    unknown = np.full((scheme.count, 2), np.nan)
    truth = np.array([face.landmarks if len(face.landmarks) else unknown for face in faces])
    return truth.reshape(-1, scheme.count, 2)


def _truth_3d(model: Model | None, scheme: Scheme, truth: np.ndarray) -> np.ndarray:
    """The labels (N, L, 3) with depths; NaN where they are none of the 3D shape, or too few to give it depth."""
    if model is None or model.space_3d is None or scheme != model.scheme:
        return np.full((*truth.shape[:2], 3), np.nan)
    return with_depth(truth, model.space_3d.model)


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
