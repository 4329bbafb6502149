"""An experiment: its configuration and folder, and the faces, folds, pictures and models that its tasks share."""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from jaxfit.data.outputs import require_same_settings
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.experiments.arrays import Arrays, load_arrays, save_arrays
from jaxfit.experiments.config import Config, DatasetPlan
from jaxfit.experiments.names import folder_names
from jaxfit.heads.model import load_head_model
from jaxfit.labels.aligned import align_labels
from jaxfit.labels.datasets import parse_spec, read_datasets, shared_scheme
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.learning.placements import CALIBRATED
from jaxfit.models.files import load, save
from jaxfit.models.model import Model
from jaxfit.schemes.known import NO_LANDMARKS
from jaxfit.schemes.normalisers import normaliser_length
from jaxfit.schemes.own import scheme_text
from jaxfit.schemes.scheme import Scheme

# The file in an experiment's folder that holds its configuration.
SETTINGS = "config.json"
# What this file has besides the configuration: how many faces each dataset has, and a digest of their labels and folds.
FACE_SETTINGS = ("faces", "labels")


@dataclass(frozen=True)
class DatasetFaces:
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
        """Differs for other faces, labels or folds; it does not depend on the folder that the pictures are in."""
        digest = hashlib.sha256("\n".join((*self.subjects, *(face.face for face in self.records))).encode())
        for array in (np.round(self.landmarks, 3), self.folds):  # rounded as machines differ
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]

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
class PoseFaces:
    """The faces of a test of pose.

    Attributes:
        scheme: what the landmarks of ``learned`` mean.
        learned: all with all landmarks.
        tested: datasets by ``FORMAT:PATH``; those without landmarks have boxes.
    """

    scheme: Scheme
    learned: tuple[FaceRecord, ...]
    tested: Mapping[str, Dataset]


class Experiment:
    """What the tasks of an experiment share.

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
    def faces(self) -> dict[str, DatasetFaces]:
        """The faces of each dataset.

        Raises:
            InputError, DatasetError: a dataset cannot be read or converted, or has too few subjects.
        """
        return {plan.name: self._read(plan) for plan in self.config.datasets}

    def _read(self, plan: DatasetPlan) -> DatasetFaces:
        datasets = read_datasets(plan.data, plan.scheme)
        scheme = shared_scheme(datasets)
        # Before the work: not all schemes have all normalisers.
        normaliser_length(np.empty((0, scheme.count, 2)), scheme, self.config.normaliser)
        complete = [(dataset, face) for dataset in datasets for face in dataset.faces if face.complete]
        # By the folder's name alone, so that folds do not depend on where the data lie.
        names = folder_names([parse_spec(dataset.spec).path for dataset, _ in complete])
        subjects = tuple(f"{name}/{face.subject}" for name, (_, face) in zip(names, complete, strict=True))
        records = tuple(face for _, face in complete)
        return DatasetFaces(
            scheme,
            records,
            subjects,
            split_by_subject(subjects, self.config.folds, self.config.seed),
            start_boxes(records, self.config.seed),
            tuple(problem for dataset in datasets for problem in dataset.problems),
        )

    @cached_property
    def pose(self) -> PoseFaces:
        """What the test of pose learns from and is tested on.

        Raises:
            InputError, DatasetError: a dataset cannot be read or converted, or they do not go together.
        """
        plan = self.config.pose
        assert plan is not None, "tasks of pose are planned with a test of pose"
        learned = read_datasets(plan.train, plan.scheme)
        scheme = shared_scheme(learned)
        complete = tuple(face for dataset in learned for face in dataset.faces if face.complete)
        if not complete:
            raise InputError(f"[pose] train: expected faces with all landmarks; found none in {', '.join(plan.train)}")
        tested = {dataset.spec: dataset for dataset in read_datasets(plan.test)}
        for spec, dataset in tested.items():
            if dataset.scheme == NO_LANDMARKS and scheme != CALIBRATED:
                raise InputError(
                    f"[pose]: {spec} has no landmarks, and where faces lie in its boxes is known for models of "
                    f"{CALIBRATED.name} only; expected train with these, got {scheme.name}"
                )
            if dataset.scheme not in (NO_LANDMARKS, scheme):
                raise InputError(
                    f"[pose]: expected test faces of {scheme.name}, as in train, or without landmarks; {spec} has "
                    f"{dataset.scheme.name}"
                )
        return PoseFaces(scheme, complete, tested)

    def result(self, name: str) -> Path:
        """The file of a task's results."""
        return result_file(self.folder, name)

    def done(self, name: str) -> bool:
        """Whether a task has results."""
        return self.result(name).exists()

    def save_result(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep a task's results, whole or not at all."""
        save_arrays(self.result(name), arrays)

    def cost(self, name: str) -> tuple[float, float] | None:
        """The seconds and the work of a task; None if it is not done.

        Raises:
            InputError: its results are damaged.
        """
        if name not in self._costs and self.done(name):
            cost = load_arrays(self.result(name), ("seconds", "work"))
            self._costs[name] = float(cost["seconds"]), float(cost["work"])
        return self._costs.get(name)

    def load_model(self, name: str) -> Model:
        """The model that a task kept."""
        return load(self._model(name))

    def save_model(self, name: str, model: Model) -> None:
        """Keep a model, whole or not at all."""
        self._model(name).parent.mkdir(parents=True, exist_ok=True)
        save(model, self._model(name))

    def _model(self, name: str) -> Path:
        return self.folder / "models" / f"{name}.safetensors"

    def keep_settings(self) -> None:
        """Write the configuration into a folder that is new, or check that its results are of the same one.

        Raises:
            InputError: they are of another, or a dataset cannot be read.
            DatasetError: a dataset cannot be read.
        """
        settings = self.config.as_json()
        # Data may lie elsewhere next time.
        for name, dataset in settings["datasets"].items():
            dataset["data"] = [_without_folders(spec) for spec in dataset["data"]]
            values = (len(self.faces[name].records), self.faces[name].digest)
            for key, value in zip(FACE_SETTINGS, values, strict=True):
                settings.setdefault(key, {})[name] = value
        for key in ("train", "test") if self.config.pose else ():
            settings["pose"][key] = [_without_folders(spec) for spec in settings["pose"][key]]
        if self.config.pose:  # read before hours of training, in case it cannot be
            settings.setdefault("faces", {})["[pose]"] = len(self.pose.learned)
        self.folder.mkdir(parents=True, exist_ok=True)
        require_same_settings(self.folder / SETTINGS, settings)

    def write_faces(self) -> None:
        """Keep what reports need of the faces, and where their pictures lie now."""
        for name, faces in self.faces.items():
            path = faces_file(self.folder, name)
            images = np.array([os.path.abspath(face.image) for face in faces.records])
            if not path.exists():
                save_arrays(path, {**_face_arrays(faces), "image": images})
            elif not np.array_equal((kept := load_arrays(path))["image"], images):
                save_arrays(path, {**kept, "image": images})


def result_file(folder: Path, name: str) -> Path:
    """The file of a task's results in the folder of an experiment."""
    return folder / "results" / f"{name}.npz"


def faces_file(folder: Path, dataset: str) -> Path:
    """The file of what is known of a dataset's faces in the folder of an experiment."""
    return folder / "datasets" / f"{dataset}.npz"


def _face_arrays(faces: DatasetFaces) -> Arrays:
    """What a report needs of the faces, other than their pictures."""
    labelled = np.array([[np.nan] * 3 if face.pose is None else face.pose for face in faces.records])
    return {
        "face": np.array([face.face for face in faces.records]),
        "subject": np.array(faces.subjects),
        "fold": faces.folds,
        "box": faces.boxes,
        "landmarks": faces.landmarks,
        "pose": np.where(np.isnan(labelled), _aligned_pose(faces), labelled),
        "scheme": np.array(scheme_text(faces.scheme)),
        "problems": np.array(faces.problems, str),
    }


def _aligned_pose(faces: DatasetFaces) -> np.ndarray:
    """(N, 3) roll, pitch and yaw in degrees of a head aligned to the labels; NaN without a head model of them."""
    try:
        model = load_head_model().of(faces.scheme, 0.99)
    except InputError:
        return np.full((len(faces.records), 3), np.nan)
    aligned = align_labels(model, faces.landmarks)
    return np.where(aligned.ok[:, None], aligned.pose, np.nan)


def _without_folders(spec: str) -> str:
    form, colon, path = spec.partition(":")
    return f"{form}:{Path(path).name}" if colon else Path(spec).name
