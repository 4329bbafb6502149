"""Comparing models, exported models and files of fits on the same labelled faces, one way of measuring for all."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.cascade.starts import Starts
from jaxfit.errors import InputError, ModelError
from jaxfit.evaluation.datasets import (
    EvaluationRun,
    StartBoxes,
    folders_of,
    for_model,
    plan_starts,
)
from jaxfit.evaluation.evaluate import Evaluation, fit_labelled, measure, require_measurable, usual_normaliser
from jaxfit.evaluation.fit_files import (
    FoundFaces,
    faces_in_pictures,
    fits_format,
    fits_of_matched,
    match_faces,
    read_fits,
)
from jaxfit.fitting.export import Exported, load_exported
from jaxfit.fitting.fit_exported import fit_exported
from jaxfit.labels.datasets import convert_dataset, read_datasets
from jaxfit.labels.importers.annotations import Annotation
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.models.files import SUFFIX, bundled, load
from jaxfit.models.model import SQUARE, Model
from jaxfit.schemes.conversions import convertible, described
from jaxfit.schemes.known import FOREIGN, IBUG68, NO_LANDMARKS, SCHEMES, scheme_of_numbered
from jaxfit.schemes.scheme import Scheme, is_name
from jaxfit.types import Progress, silent

OWN_BOXES = "its own"  # where a program that wrote a file looked for faces


@dataclass(frozen=True)
class Contestant:
    """What is compared.

    Attributes:
        name: what tables call it.
        source: where it came from.
        what: a model, an exported model, or faces that some program found.
    """

    name: str
    source: str
    what: Model | Exported | FoundFaces

    @property
    def scheme(self) -> Scheme:
        """What its landmarks mean."""
        return self.what.scheme

    @property
    def landmarked(self) -> bool:
        """Whether it finds landmarks."""
        return self.scheme != NO_LANDMARKS

    @property
    def posed(self) -> bool:
        """Whether it finds poses."""
        if isinstance(self.what, Model):
            return self.what.space_3d is not None
        return "pose" in self.what.outputs if isinstance(self.what, Exported) else self.what.posed


def read_contestants(specs: Sequence[str]) -> list[Contestant]:
    """The contestants that ``NAME=WHAT``, or ``WHAT`` alone, name: bundled models, files of models or of exported
    ones, or files of fits, as `read_fits` reads them.

    Raises:
        InputError: a name is no name, or comes twice, or there is nothing of this kind.
        ModelError: a model cannot be read.
        DatasetError: a file of fits cannot be read.
    """
    contestants: list[Contestant] = []
    for spec in specs:
        name, equals, source = spec.partition("=")
        if not equals or Path(spec).exists():
            name, source = "", spec
        what = _read_contestant(source)
        name = name or (source if source in bundled() else Path(source.partition(":")[2] or source).stem)
        if not is_name(name) or name in (each.name for each in contestants):
            raise InputError(f"expected contestants of different names, as NAME={source}; got {name!r} of {spec}")
        contestants.append(Contestant(name, source, what))
    return contestants


def _read_contestant(source: str) -> Model | Exported | FoundFaces:
    if source not in bundled() and not source.endswith(SUFFIX):
        if not source or fits_format(source) is None:
            raise InputError(
                f"expected a model (one of {', '.join(bundled())}, or a file that ends in {SUFFIX}) or a file of fits "
                f"(.csv, .jsonl, .json, or a folder of .pts); got {source!r}"
            )
        return read_fits(source)
    try:
        return load(source)
    except ModelError as no_model:
        try:
            return load_exported(source)
        except ModelError:
            raise no_model from None


@dataclass(frozen=True, eq=False)
class Entry:
    """How one contestant did on one dataset.

    Attributes:
        contestant: who.
        evaluation: its fits of all faces, and their errors.
        boxes: where its fits started, in words.
        extra: rows of its file, in pictures of the dataset, that are no labelled face.
    """

    contestant: Contestant
    evaluation: Evaluation
    boxes: str
    extra: int = 0

    @property
    def errors(self) -> np.ndarray | None:
        """(N,) as in `Evaluation`; None if it finds no landmarks, or the dataset has none."""
        return self.evaluation.errors if self.contestant.landmarked else None

    @property
    def poses(self) -> np.ndarray | None:
        """(N, 3) in the orders of the labelled ones; None if it finds no poses."""
        return self.evaluation.ordered_pose if self.contestant.posed else None


@dataclass(frozen=True, eq=False)
class Comparison:
    """How contestants did on the same faces of one dataset.

    Attributes:
        dataset: its labels are what errors are measured against.
        scheme: what the landmarks mean in which errors are measured.
        normaliser: what the errors are relative to.
        entries: in the order of the contestants.
    """

    dataset: Dataset
    scheme: Scheme
    normaliser: str
    entries: tuple[Entry, ...]

    @property
    def subjects(self) -> np.ndarray:
        """(N,) the subject of each face."""
        return np.array([face.subject for face in self.dataset.faces])

    @property
    def true_pose(self) -> np.ndarray:
        """(N, 3) labelled roll, pitch and yaw in degrees, NaN where unknown."""
        return self.entries[0].evaluation.true_pose

    @property
    def errors(self) -> dict[str, np.ndarray]:
        """By name, the errors (N,) of those that find landmarks, if a face can be measured."""
        found = {entry.contestant.name: errors for entry in self.entries if (errors := entry.errors) is not None}
        return {} if all(np.isnan(errors).all() for errors in found.values()) else found

    @property
    def poses(self) -> dict[str, np.ndarray]:
        """By name, the poses (N, 3) of those that find some, if a pose is labelled."""
        if not np.isfinite(self.true_pose).any():
            return {}
        return {entry.contestant.name: poses for entry in self.entries if (poses := entry.poses) is not None}


@dataclass(frozen=True)
class ComparisonPlan:
    """A comparison that is known to be possible; `compare` does it.

    Attributes:
        run: how models are run.
        contestants: who are compared.
        datasets: what they are compared on, with labels as the datasets have them.
        schemes: in which errors are measured on each.
        starts: where the fits of models start; None without any.
        notes: what was decided, and what of files is not used, a sentence each.
    """

    run: EvaluationRun
    contestants: tuple[Contestant, ...]
    datasets: tuple[Dataset, ...]
    schemes: tuple[Scheme, ...]
    starts: StartBoxes | None
    notes: tuple[str, ...]
    _found: Mapping[str, Mapping[Path, list[Annotation]]]

    def compare(self, progress: Progress = silent) -> list[Comparison]:
        """The comparison on each dataset.

        Args:
            progress: called with the stage's name, what is done and what there is to do.

        Raises:
            InputError: as ``jaxfit.evaluate``.
        """
        return [self._compared(*pair, progress) for pair in zip(self.datasets, self.schemes, strict=True)]

    def _compared(self, dataset: Dataset, scheme: Scheme, progress: Progress) -> Comparison:
        labels = _relabelled(dataset, scheme)
        normaliser = self.run.normaliser or usual_normaliser(scheme, labels.faces)
        how: dict[str, Any] = {"scheme": scheme, "normaliser": normaliser}
        # Faces are looked for once, for all models.
        detected = None
        if self.starts is not None and self.starts.detector is not None:
            detected = self.starts.of(dataset.faces, "", progress)
        entries = []
        for contestant in self.contestants:
            what = contestant.what
            if isinstance(what, FoundFaces):
                entries.append(self._entry_of_file(contestant, what, labels.faces, how))
                continue
            assert self.starts is not None
            if isinstance(what, Exported):
                kind = self.starts.kinds or SQUARE
                boxes, kinds, rotations = detected or self.starts.of(_own_labels(what.scheme, dataset).faces, kind)
                begin = time.perf_counter()
                fits = fit_exported(what, [face.image for face in labels.faces], boxes, kinds, rotations)
                seconds = (time.perf_counter() - begin) / max(int(fits.fitted.sum()), 1)
                evaluation = measure(fits, labels.faces, seconds_per_face=seconds, **how)
            else:
                kind = self.starts.kind_for(what, dataset, [])
                boxes, kinds, rotations = detected or self.starts.of(for_model(what, dataset, []).faces, kind)
                pipeline = self.starts.pipeline(what, self.run.fitting)
                fits, seconds, learned = fit_labelled(
                    pipeline, labels.faces, boxes, kind=kinds, rotations=rotations, progress=progress
                )
                evaluation = measure(fits, labels.faces, model=what, seconds_per_face=seconds, learned=learned, **how)
            unboxed = "the dataset's" if dataset.scheme == NO_LANDMARKS else "around the labels"
            entries.append(Entry(contestant, evaluation, self.starts.kinds or unboxed))
        return Comparison(labels, scheme, normaliser, tuple(entries))

    def _entry_of_file(
        self, contestant: Contestant, what: FoundFaces, faces: Sequence[FaceRecord], how: Mapping[str, Any]
    ) -> Entry:
        """How a program did that wrote a file, on faces labelled in the scheme that errors are measured in."""
        of_pictures, scheme = self._found[contestant.name], how["scheme"]
        matched = match_faces(faces, of_pictures, what.scheme, scheme)
        fits = fits_of_matched(matched, faces, what.scheme, scheme, contestant.posed)
        there = sum(len(of_pictures.get(picture, ())) for picture in {face.image for face in faces})
        extra = there - sum(face is not None for face in matched)
        return Entry(contestant, measure(fits, faces, **how), OWN_BOXES, extra)


def _own_labels(scheme: Scheme, dataset: Dataset) -> Dataset:
    return convert_dataset(dataset, scheme) if convertible(dataset.scheme, scheme) else dataset


def plan_comparison(
    contestants: Sequence[Contestant], specs: Sequence[str], run: EvaluationRun = EvaluationRun()
) -> ComparisonPlan:
    """Read datasets, and check that contestants can be compared on them, before the work.

    Errors are measured in the scheme of most landmarks that all contestants' landmarks and the labels are, or can be
    converted to.

    Args:
        contestants: who are compared, as `read_contestants` reads them.
        specs: datasets, ``FORMAT:PATH`` as in ``jaxfit.read_dataset``.
        run: how models are run; ``refine`` must be off, and ``scheme`` is what errors are measured in.

    Raises:
        InputError: no contestants, no common scheme, names in a file that may mean several pictures, or as
            `plan_evaluation`.
        DatasetError: a dataset cannot be read.
    """
    if not contestants:
        raise InputError("expected a model or a file of fits to measure; got none")
    datasets = read_datasets(specs, run.scheme)
    if run.scheme is None and any(each.scheme.name in (*SCHEMES, *FOREIGN) for each in contestants):
        datasets = [replace(dataset, scheme=scheme_of_numbered(dataset.scheme)) for dataset in datasets]
    schemes = [_shared_scheme(contestants, dataset, run.scheme is not None) for dataset in datasets]
    models = [each.what for each in contestants if isinstance(each.what, Model)]
    exported = [each for each in contestants if isinstance(each.what, Exported)]
    starts = plan_starts(run, models, datasets) if models or exported else None
    if starts is None and (run.boxes or run.fitting.detector):
        raise InputError("expected boxes or a detector for models, which fit in them; got only files of fits")
    if exported and run.fitting.starts != Starts():
        raise InputError(
            f"{exported[0].name}: an exported model has the starts that it was exported with; leave out --starts"
        )
    for each in exported:
        assert starts is not None
        assert isinstance(each.what, Exported)
        drawn = {*(starts.kinds or SQUARE).split(", ")}
        if lacking := drawn - each.what.placements.keys():
            raise InputError(
                f"{each.name}: this exported model knows boxes of the kinds {', '.join(each.what.placements)}; got "
                f"{', '.join(sorted(lacking))}"
            )
    notes: list[str] = []
    for dataset, scheme in zip(datasets, schemes, strict=True):
        if dataset.scheme != NO_LANDMARKS and dataset.scheme != scheme:
            notes.append(f"{dataset.spec}: errors are measured in {scheme.name}, which the labels are converted to")
        for each in contestants:
            if each.landmarked and each.scheme != scheme:
                notes.append(f"{dataset.spec}: {each.name}'s landmarks are converted from {each.scheme.name}")
            if each.landmarked:
                require_measurable(each.scheme, scheme, run.normaliser, _relabelled(dataset, scheme).faces)
    pictures = [face.image for dataset in datasets for face in dataset.faces]
    found: dict[str, Mapping[Path, list[Annotation]]] = {}
    for each in contestants:
        if isinstance(each.what, FoundFaces):
            found[each.name], unused = faces_in_pictures(each.what, pictures, folders_of(datasets))
            notes += [f"{each.name}: {problem}" for problem in each.what.problems]
            if not found[each.name]:
                raise InputError(
                    f"{each.source}: expected fits of pictures of {', '.join(specs)}; none of its {len(unused)} names "
                    f"is one, such as {unused[0]}: give their paths"
                )
            if unused:
                notes.append(f"{each.name}: rows for pictures that no dataset has: {len(unused)}, such as {unused[0]}")
    if found and starts is not None and starts.detector is None and starts.given is None:
        notes.append(
            "models start from boxes around the labels, and miss no face; files of fits have what their programs "
            "found: name a --detector, or give all the same boxes, for a comparison of both from the picture on"
        )
    return ComparisonPlan(run, tuple(contestants), tuple(datasets), tuple(schemes), starts, tuple(notes), found)


def _relabelled(dataset: Dataset, scheme: Scheme) -> Dataset:
    return dataset if dataset.scheme in (scheme, NO_LANDMARKS) else convert_dataset(dataset, scheme)


def _shared_scheme(contestants: Sequence[Contestant], dataset: Dataset, fixed: bool) -> Scheme:
    """The scheme of most landmarks that all can be measured in; the labels' own if it is ``fixed``."""
    own = [each.scheme for each in contestants if each.landmarked]
    labels = [] if dataset.scheme == NO_LANDMARKS else [dataset.scheme]
    if not own:  # only poses
        return labels[0] if labels else IBUG68
    candidates = labels if fixed and labels else [*SCHEMES.values(), *labels, *own]
    shared = [
        target
        for target in candidates
        if all(scheme == target or convertible(scheme, target) for scheme in (*labels, *own))
    ]
    if not shared:
        several = ", ".join(dict.fromkeys(described(scheme) for scheme in (*labels, *own)))
        raise InputError(
            f"{dataset.spec}: expected landmarks that all can be converted to (--scheme); got those of {several}"
        )
    return max(shared, key=lambda scheme: scheme.count)
