"""Measuring a model on whole datasets: where the fits start, in which scheme errors are measured, and the report."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import isfinite, isnan
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.boxes import GivenBox, boxes_of_pictures
from jaxfit.data.detectors import Detector, Search, all_rough
from jaxfit.data.names import plain, table_path, table_word
from jaxfit.data.pictures import read_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import detected_boxes, share_boxes, start_boxes
from jaxfit.evaluation.evaluate import Evaluation, fit_labelled, measure, require_measurable
from jaxfit.evaluation.pose import pose_report
from jaxfit.evaluation.statistics import intervals, summarise
from jaxfit.evaluation.uncertainty import uncertainty_report
from jaxfit.fitting.given_boxes import read_known_boxes
from jaxfit.fitting.pipeline import Fitting, Pipeline, require_fitting
from jaxfit.fitting.refine import refine, require_refinable
from jaxfit.labels.datasets import convert_dataset, parse_spec, read_datasets
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.models.model import SQUARE, Model
from jaxfit.schemes.conversions import convertible
from jaxfit.schemes.known import NO_LANDMARKS, SCHEMES
from jaxfit.schemes.normalisers import NORMALISERS
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import ANGLES
from jaxfit.types import Progress, silent

_BOX_COLUMNS = ("x", "y", "width", "height")
_POSE_COLUMNS = tuple(f"{of}{angle}" for of in ("", "true_") for angle in ANGLES)
_MEASURED_COLUMNS = (*_BOX_COLUMNS, "nmed", "nmed_3d", *_POSE_COLUMNS, "pose_order")
FACE_COLUMNS = ("dataset", "face", "subject", "image", *_MEASURED_COLUMNS, "learned", "problem")


@dataclass(frozen=True)
class EvaluationRun:
    """How a model is measured on datasets.

    Attributes:
        fitting: of the faces. They are looked for if a detector is named; else fits start in ``boxes``, or in the
            squares around the true landmarks, moved a little, or, where there are none, in the dataset's own boxes.
        boxes: a CSV file of face boxes, as in ``jaxfit.FolderRun``.
        box_kind: what drew those boxes; None takes what the file says.
        seed: of how the squares are moved.
        scheme: the landmark scheme that labels are converted to, as ``--scheme`` takes it; None: the model's where that
            is possible.
        normaliser: what errors are relative to, as in ``jaxfit.evaluate``.
        refine: refine 3D alignments, as ``jaxfit.refine`` does.
    """

    fitting: Fitting = field(default_factory=Fitting)
    boxes: str | Path | None = None
    box_kind: str | None = None
    seed: int = 0
    scheme: str | None = None
    normaliser: str | None = None
    refine: bool = False

    def __post_init__(self) -> None:
        require_fitting(self.fitting)


@dataclass(frozen=True)
class PlannedDataset:
    """A dataset that is to be measured on.

    Attributes:
        dataset: its labels are converted already.
        scheme: in which errors are measured.
        box_kind: what draws the boxes that fits start from, for reports; of files all kinds, in words.
    """

    dataset: Dataset
    scheme: Scheme
    box_kind: str


@dataclass(frozen=True)
class StartBoxes:
    """Where fits of labelled faces start, whatever fits them.

    Attributes:
        seed: of how the squares around the true landmarks are moved, where neither of the next two is there.
        given: the boxes of each picture, of a file; or None.
        detector: finds the faces; or None.
        kinds: what draws the boxes, in words; empty where it depends on the dataset.
        rough: whether they are rough, as `Detector` says.
        unused: names of pictures in the file of boxes that no dataset has.
    """

    seed: int
    given: Mapping[Path, Sequence[GivenBox]] | None
    detector: Detector | None
    kinds: str
    rough: bool
    unused: tuple[str, ...]

    def of(
        self, faces: Sequence[FaceRecord], kind: str, progress: Progress = silent
    ) -> tuple[np.ndarray, str | list[str], np.ndarray | None]:
        """The boxes (N, 4) of labelled faces, their kinds, ``kind`` if nothing else is known, and their rotations."""
        if self.detector is not None:
            return detected_boxes(faces, self.detector, progress=progress)
        if self.given is not None:
            return share_boxes(faces, self.given)
        return start_boxes(faces, self.seed), kind, None

    def kind_for(self, model: Model, dataset: Dataset, notes: list[str]) -> str:
        """The kind of the boxes that fits of a dataset start from, for reports; of files all kinds, in words."""
        return self.kinds or _start_kind(model, dataset, notes)

    def pipeline(self, model: Model, fitting: Fitting) -> Pipeline:
        """How a model fits faces in these boxes."""
        in_boxes = replace(fitting, detector=None, search=Search())
        return in_boxes.pipeline_in_boxes(model, self.rough, read_grey)


@dataclass(frozen=True)
class EvaluationPlan:
    """An evaluation that is known to be possible; `evaluate` does it.

    Attributes:
        run: what was asked for.
        pipeline: how faces are fitted in their boxes.
        datasets: what is measured on.
        starts: where the fits start.
        notes: what was decided, such as conversions of labels, a sentence each.
    """

    run: EvaluationRun
    pipeline: Pipeline
    datasets: tuple[PlannedDataset, ...]
    starts: StartBoxes
    notes: tuple[str, ...]

    @property
    def unused(self) -> tuple[str, ...]:
        """Names of pictures in the file of boxes that no dataset has."""
        return self.starts.unused

    def evaluate(self, progress: Progress = silent) -> dict[str, Evaluation]:
        """The evaluations, by the datasets' specs.

        Args:
            progress: called with the stage's name, what is done and what there is to do.

        Raises:
            InputError: as ``jaxfit.evaluate``.
            ProcessError: another of the joined processes ended.
        """
        return {planned.dataset.spec: self._evaluated(planned, progress) for planned in self.datasets}

    def _evaluated(self, planned: PlannedDataset, progress: Progress) -> Evaluation:
        faces, model = planned.dataset.faces, self.pipeline.model
        boxes, kinds, rotations = self.starts.of(faces, planned.box_kind, progress)
        fits, seconds, learned = fit_labelled(
            self.pipeline, faces, boxes, kind=kinds, rotations=rotations, progress=progress
        )
        return measure(
            refine(model, fits) if self.run.refine else fits,
            faces,
            scheme=planned.scheme,
            normaliser=self.run.normaliser,
            model=model,
            seconds_per_face=seconds,
            learned=learned,
        )


def plan_evaluation(model: Model, specs: Sequence[str], run: EvaluationRun = EvaluationRun()) -> EvaluationPlan:
    """Read datasets, and check that a model can be measured on them, before the work.

    Labels of another landmark scheme than the model's are converted to it where that is possible; or the model's fits
    to theirs.

    Args:
        model: the model.
        specs: datasets, ``FORMAT:PATH`` as in ``jaxfit.read_dataset``.
        run: how it is measured.

    Raises:
        InputError: labels or fits that cannot be converted, an unknown normaliser, detector or kind of box, a wrong
            file of boxes, both boxes and a detector, a search without a detector, or a model with nothing to refine.
        DatasetError: a dataset cannot be read.
    """
    notes: list[str] = []
    datasets = read_datasets(specs, run.scheme)
    if run.scheme is None:
        datasets = [for_model(model, dataset, notes) for dataset in datasets]
    schemes = [_measured_scheme(model, dataset) for dataset in datasets]
    for dataset, scheme in zip(datasets, schemes, strict=True):
        require_measurable(model.scheme, scheme, run.normaliser, dataset.faces)
    starts = plan_starts(run, [model], datasets)
    planned = tuple(
        PlannedDataset(dataset, scheme, starts.kind_for(model, dataset, notes))
        for dataset, scheme in zip(datasets, schemes, strict=True)
    )
    return EvaluationPlan(run, starts.pipeline(model, run.fitting), planned, starts, tuple(notes))


def plan_starts(run: EvaluationRun, models: Sequence[Model], datasets: Sequence[Dataset]) -> StartBoxes:
    """Where the fits of some models start on datasets, as a run asks for it.

    Raises:
        InputError: an unknown detector or kind of box, a wrong file of boxes, both boxes and a detector, a search
            without a detector, or a model with nothing to refine.
    """
    fitting = run.fitting
    if run.boxes is not None:
        fitting.require_given_boxes()
    if fitting.detector is None and fitting.search != Search():
        raise InputError(
            "expected a detector with smallest, score or any rotation, which say how it looks for faces; got none: "
            "name it, or leave these out"
        )
    named = None
    for model in models:
        named = read_known_boxes(run.boxes, run.box_kind, model)
        if run.refine:
            require_refinable(model)
    if fitting.detector is not None:
        detector = fitting.finder()
        for model, kind in product(models, detector.kinds):  # before any picture is searched
            model.placement(kind)
        kinds = fitting.detector if isinstance(fitting.detector, str) else ", ".join(detector.kinds)
        return StartBoxes(run.seed, None, detector, kinds, detector.rough, ())
    if named is not None:
        boxes, unused = _boxes_of_pictures(run.boxes, named, datasets)
        drawn_by = {box.kind for several in named.values() for box in several}
        return StartBoxes(
            run.seed, boxes, None, ", ".join(sorted(drawn_by)) or SQUARE, all_rough(drawn_by), tuple(unused)
        )
    return StartBoxes(run.seed, None, None, "", False, ())


def folders_of(datasets: Sequence[Dataset]) -> list[Path]:
    """The folders of datasets, which paths in tables may be relative to."""
    paths = [Path(parse_spec(dataset.spec)[2]) for dataset in datasets]
    return [path if path.is_dir() else path.parent for path in paths]


def _boxes_of_pictures(
    file: str | Path | None, named: Mapping[str, Sequence[GivenBox]], datasets: Sequence[Dataset]
) -> tuple[dict[Path, list[GivenBox]], list[str]]:
    """The boxes of a file by picture, and the names that no picture has; a name in the file must not mean pictures of
    two datasets either."""
    folders = [Path(file or "").parent, *folders_of(datasets)]
    try:
        return boxes_of_pictures(named, [face.image for dataset in datasets for face in dataset.faces], folders)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def for_model(model: Model, dataset: Dataset, notes: list[str]) -> Dataset:
    """The dataset in the model's landmark scheme where its labels can be converted, which is noted; else as it is."""
    if not convertible(dataset.scheme, model.scheme):
        return dataset
    if {dataset.scheme.name, model.scheme.name} & SCHEMES.keys():
        notes.append(f"{dataset.spec}: labels converted from {dataset.scheme.name} to the model's {model.scheme.name}")
    return convert_dataset(dataset, model.scheme)


def _measured_scheme(model: Model, dataset: Dataset) -> Scheme:
    """The scheme that errors are measured in: the labels' own where the model's fits can be converted to it."""
    return dataset.scheme if convertible(model.scheme, dataset.scheme) else model.scheme


def _start_kind(model: Model, dataset: Dataset, notes: list[str]) -> str:
    """The kind of the boxes that fits start from if none are given: datasets without landmarks have their own."""
    own = parse_spec(dataset.spec)[0]
    if dataset.scheme != NO_LANDMARKS:
        return SQUARE
    if own in model.known_placements:
        return own
    notes.append(
        f"{dataset.spec}: the model does not know how faces lie in {own} boxes and takes them for {SQUARE} ones"
    )
    return SQUARE


def evaluation_report(result: Evaluation) -> dict[str, Any]:
    """An evaluation's part of ``report.json``, as JSON values; ``ci95`` is half the width of the mean's 95 % confidence
    interval, ``intervals`` are bootstrap intervals, both by subject."""
    seconds = result.seconds_per_face
    fitted = int(result.fits.fitted.sum())
    subjects = [face.subject for face in result.faces]
    return {
        **summarise(result.errors, subjects=subjects).as_json(),
        "intervals": intervals(result.errors, subjects=subjects).as_json(),
        "fitted": fitted,
        "undetected": len(result.faces) - fitted,
        "learned_from": None if result.learned is None else int(result.learned.sum()),
        "normaliser": NORMALISERS[result.normaliser].title,
        "seconds_per_face": seconds if isfinite(seconds) else None,
        **distances_report(result),
        **uncertainty_report(result),
        **_report_3d(result),
    }


def distances_report(result: Evaluation) -> dict[str, Any]:
    """How far fitted landmarks are from the true ones, over those of fitted faces that are annotated: in pixels, for
    each landmark, and in units where the length of a pixel is known; JSON values."""
    pixels = result.distances
    known = np.isfinite(pixels)
    if not known.any():
        return {}
    units = pixels * np.array([face.scale or np.nan for face in result.faces])[:, None]
    of_landmark = {
        result.scheme.point_name(index): round(float(pixels[known[:, index], index].mean()), 4)
        for index in range(result.scheme.count)
        if known[:, index].any()
    }
    report: dict[str, Any] = {"pixels": _distances(pixels[known]), "pixels_of_landmarks": of_landmark}
    if (scaled := np.isfinite(units)).any():
        report["units"] = {"unit": result.scheme.unit or "units", **_distances(units[scaled])}
    return report


def _distances(values: np.ndarray) -> dict[str, float]:
    numbers = {"mean": values.mean(), "median": np.median(values), "ninety_percent": np.quantile(values, 0.9)}
    return {name: round(float(number), 4) for name, number in numbers.items()}


def _report_3d(result: Evaluation) -> dict[str, Any]:
    """What is said of 3D models only."""
    if result.fits.pose is None or result.errors_3d is None:
        return {}
    return {
        "nmed_3d": summarise(result.errors_3d).as_json()["nmed"],
        "pose": pose_report(result.ordered_pose, result.true_pose),
        "pose_order": sorted({face.pose_order for face in result.faces if face.pose is not None}),
    }


def face_rows(results: Mapping[str, Evaluation]) -> Iterator[list[object]]:
    """A row of ``FACE_COLUMNS`` for each face of evaluations by their datasets' names.

    ``nmed`` is ``inf`` without a fit, ``nan`` where the truth does not allow to measure. Fitted angles are in the order
    of the labelled ones, and may be others than those of ``jaxfit fit``.
    """
    for spec, result in results.items():
        why = {problem.row: str(problem) for problem in result.fits.problems}
        for number, face in enumerate(result.faces):
            box = [f"{value:.3f}" for value in result.fits.boxes[number]]
            error = result.errors[number]
            error_3d = "" if result.errors_3d is None else f"{result.errors_3d[number]:.6f}"
            angles = np.concatenate([result.ordered_pose[number], result.true_pose[number]])
            pose = ["" if isnan(angle) else f"{angle:.3f}" for angle in angles]
            problem = why.get(number, "the normaliser's points are not annotated" if isnan(error) else "")
            numbers = [*box, f"{error:.6f}", error_3d, *pose]
            names = [table_word(face.face), table_word(face.subject), table_path(face.image)]
            learned = "" if result.learned is None else int(result.learned[number])
            yield [plain(spec), *names, *numbers, face.pose_order, learned, table_word(problem)]
