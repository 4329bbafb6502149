"""What the cells of an experiment share: faces, folds, pictures in memory, models, and where things are kept."""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from jaxfit.data.outputs import atomic_write
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import InputError
from jaxfit.evaluation.evaluate import start_boxes
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.experiments.config import Config, DatasetPlan, MethodPlan
from jaxfit.heads.model import load_head_model
from jaxfit.labels.aligned import align_labels
from jaxfit.labels.datasets import convert_dataset, parse_spec, read_dataset
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.learning.methods import METHODS, Options, view_of
from jaxfit.learning.placements import CALIBRATED
from jaxfit.models.files import load, save
from jaxfit.models.model import Model
from jaxfit.schemes.known import NO_LANDMARKS, scheme_named
from jaxfit.schemes.scheme import Scheme

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Faces:
    """The faces of a dataset that methods are compared on: those with all landmarks.

    Attributes:
        scheme: what the landmarks mean.
        records: the N faces.
        subjects: of each; no subject is in two folds.
        folds: (N,) the fold that each is tested in.
        boxes: (N, 4) that their fits start from, in pixels.
        problems: what could not be read.
    """

    scheme: Scheme
    records: tuple[FaceRecord, ...]
    subjects: tuple[str, ...]
    folds: np.ndarray
    boxes: np.ndarray
    problems: tuple[str, ...]

    @property
    def landmarks(self) -> np.ndarray:
        """(N, L, 2) labels, in pixels."""
        return np.stack([face.landmarks for face in self.records])

    @property
    def digest(self) -> str:
        """Tells these faces, their labels and folds from others, wherever they lie."""
        told = hashlib.sha256("\n".join((*self.subjects, *(face.face for face in self.records))).encode())
        for array in (np.round(self.landmarks, 3), self.folds):  # rounded as machines differ
            told.update(np.ascontiguousarray(array).tobytes())
        return told.hexdigest()[:16]

    def tested(self, fold: int) -> np.ndarray:
        """Numbers of the faces in a fold."""
        return np.flatnonzero(self.folds == fold)

    def learned(self, fold: int) -> np.ndarray:
        """Numbers of the faces in all others."""
        return np.flatnonzero(self.folds != fold)

    def chosen(self, numbers: np.ndarray) -> list[FaceRecord]:
        """Faces by their numbers."""
        return [self.records[number] for number in numbers]


@dataclass(frozen=True)
class PoseData:
    """The faces of a test of pose.

    Attributes:
        scheme: what the landmarks of ``learned`` mean.
        learned: all with all landmarks.
        tested: datasets by ``FORMAT:PATH``; those without landmarks have boxes.
    """

    scheme: Scheme
    learned: tuple[FaceRecord, ...]
    tested: Mapping[str, Dataset]


class Lab:
    """An experiment's shared things.

    Args:
        config: what is run.
        folder: where results are kept.
    """

    def __init__(self, config: Config, folder: Path):
        self.config = config
        self.folder = folder
        self.pictures = GreyPictures()
        self._costs: dict[str, tuple[float, float]] = {}

    @cached_property
    def faces(self) -> dict[str, Faces]:
        """The faces of each dataset.

        Raises:
            InputError, DatasetError: a dataset cannot be read or converted, or has too few subjects.
        """
        return {plan.name: self._read(plan) for plan in self.config.datasets}

    def _read(self, plan: DatasetPlan) -> Faces:
        datasets = read_all(plan.data, plan.scheme)
        scheme = same_scheme(datasets)
        complete = [(dataset, face) for dataset in datasets for face in dataset.faces if face.complete]
        # By folder, so that folds do not depend on where the data lie.
        names = [Path(parse_spec(dataset.spec)[2]).name for dataset, _ in complete]
        subjects = tuple(f"{name}/{face.subject}" for name, (_, face) in zip(names, complete, strict=True))
        records = tuple(face for _, face in complete)
        return Faces(
            scheme,
            records,
            subjects,
            split_by_subject(subjects, self.config.folds, self.config.seed),
            start_boxes(records, self.config.seed),
            tuple(problem for dataset in datasets for problem in dataset.problems),
        )

    @cached_property
    def pose(self) -> PoseData:
        """What the test of pose learns from and is tested on.

        Raises:
            InputError, DatasetError: a dataset cannot be read or converted, or they do not go together.
        """
        plan = self.config.pose
        assert plan is not None, "cells of pose are planned with a test of pose"
        learned = read_all(plan.train, plan.scheme)
        scheme = same_scheme(learned)
        complete = tuple(face for dataset in learned for face in dataset.faces if face.complete)
        if not complete:
            raise InputError(f"[pose] train: expected faces with all landmarks; found none in {', '.join(plan.train)}")
        tested = {dataset.spec: dataset for dataset in read_all(plan.test, None)}
        for spec, dataset in tested.items():
            if dataset.scheme == NO_LANDMARKS and scheme != CALIBRATED:
                raise InputError(
                    f"[pose]: {spec} has no landmarks, and how faces lie in its boxes can be told to models of "
                    f"{CALIBRATED.name} only; expected train with these, got {scheme.name}"
                )
            if dataset.scheme not in (NO_LANDMARKS, scheme):
                raise InputError(
                    f"[pose]: expected test faces of {scheme.name}, as in train, or without landmarks; {spec} has "
                    f"{dataset.scheme.name}"
                )
        return PoseData(scheme, complete, tested)

    def result(self, name: str) -> Path:
        """The file of a cell's results."""
        return self.folder / "cells" / f"{name}.npz"

    def save_result(self, name: str, arrays: dict[str, np.ndarray]) -> None:
        """Keep a cell's results, whole or not at all."""
        save_arrays(self.result(name), arrays)

    def cost(self, name: str) -> tuple[float, float] | None:
        """The seconds and the work of a cell; None if it is not done."""
        if name not in self._costs and self.result(name).exists():
            told = load_arrays(self.result(name), ("seconds", "work"))
            self._costs[name] = float(told["seconds"]), float(told["work"])
        return self._costs.get(name)

    def load_model(self, name: str) -> Model:
        """The model that a cell kept."""
        return load(self._model(name))

    def save_model(self, name: str, model: Model) -> None:
        """Keep a model, whole or not at all."""
        self._model(name).parent.mkdir(parents=True, exist_ok=True)
        save(model, self._model(name))

    def _model(self, name: str) -> Path:
        return self.folder / "models" / f"{name}.safetensors"

    def write_faces(self) -> None:
        """Keep what is known of the faces, for reports, and where their pictures lie now."""
        for name, faces in self.faces.items():
            path = self.folder / "datasets" / f"{name}.npz"
            images = np.array([os.path.abspath(face.image) for face in faces.records])
            if not path.exists():
                save_arrays(path, {**_described(faces), "image": images})
            elif not np.array_equal((kept := load_arrays(path))["image"], images):
                save_arrays(path, {**kept, "image": images})


def read_all(specs: Sequence[str], scheme: str | None) -> list[Dataset]:
    """Datasets, with labels converted to the scheme of a name if one is given.

    Raises:
        InputError, DatasetError: one cannot be read or converted.
    """
    datasets = [read_dataset(spec) for spec in specs]
    return datasets if scheme is None else [convert_dataset(dataset, scheme_named(scheme)) for dataset in datasets]


def same_scheme(datasets: Sequence[Dataset]) -> Scheme:
    """The landmark scheme that all datasets have.

    Raises:
        InputError: they have several.
    """
    schemes = {dataset.scheme.name: dataset.scheme for dataset in datasets}
    if len(schemes) > 1:
        raise InputError(f"expected datasets of one landmark scheme; got {', '.join(schemes)}; scheme converts some")
    return next(iter(schemes.values()))


def cascades(methods: Sequence[MethodPlan]) -> list[tuple[MethodPlan, ...]]:
    """Methods that one training serves, together: 3D alignment learns the cascade of the parametric method."""
    groups: list[list[MethodPlan]] = []
    for plan in methods:
        for group in groups:
            heads = {other.options.head_model for other in [*group, plan] if other.in_3d}
            if len(heads) <= 1 and _cascade(plan) == _cascade(group[0]):
                group.append(plan)
                break
        else:
            groups.append([plan])
    return [tuple(group) for group in groups]


def _cascade(plan: MethodPlan) -> tuple[object, Options]:
    """What makes the cascade of a method."""
    descriptor, frame = view_of(plan.method, plan.options)
    return METHODS[plan.method].learn_space, plan.options.but(descriptor=descriptor, frame=frame, head_model="")


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays, none of them of objects, as NumPy's npz, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_arrays(path: Path, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of a file of `save_arrays`, all or those that are named.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names or arrays.files}
    except FileNotFoundError:
        raise InputError(f"{path}: is missing; run the experiment again, which writes it") from None
    except (ValueError, OSError, EOFError, KeyError, BadZipFile) as error:
        raise InputError(f"{path}: is damaged ({error}); delete it and run the experiment again") from None


def _described(faces: Faces) -> dict[str, np.ndarray]:
    """What a report needs of the faces, but their pictures."""
    labelled = np.array([[np.nan] * 3 if face.pose is None else face.pose for face in faces.records])
    return {
        "face": np.array([face.face for face in faces.records]),
        "subject": np.array(faces.subjects),
        "fold": faces.folds,
        "box": faces.boxes,
        "landmarks": faces.landmarks,
        "pose": np.where(np.isnan(labelled), _aligned_pose(faces), labelled),
        "scheme": np.array(faces.scheme.name),
        "problems": np.array(faces.problems, str),
    }


def _aligned_pose(faces: Faces) -> np.ndarray:
    """(N, 3) roll, pitch and yaw in degrees that the labels tell; NaN without a head model of them."""
    try:
        model = load_head_model().of(faces.scheme, 0.99)
    except InputError:
        return np.full((len(faces.records), 3), np.nan)
    aligned = align_labels(model, faces.landmarks)
    return np.where(aligned.ok[:, None], aligned.pose, np.nan)
