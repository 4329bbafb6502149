"""The cells of an experiment: pieces of work with a name, whose results are arrays, run in any order their needs allow.

What cells share is exact. One training serves all numbers of steps, because each step is learned after those before it
and does not know of those after; and it serves both the parametric method and 3D alignment, which learn the same
cascade. Trainings of different augmentations, folds or datasets share nothing but the pictures in memory: already their
second steps see different windows.
"""

import os
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from jaxfit.cascade.model import first_steps
from jaxfit.cascade.starts import Starts
from jaxfit.errors import ImageError, InputError
from jaxfit.evaluation.evaluate import Evaluation, evaluate, evaluate_steps
from jaxfit.experiments.config import Config, MethodPlan
from jaxfit.experiments.lab import Lab, Progress, cascades
from jaxfit.fitting.fit import fit
from jaxfit.labels.datasets import parse_spec
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.placements import evaluate_pose
from jaxfit.learning.train import Trained, train
from jaxfit.models.model import Model
from jaxfit.schemes.scheme import Scheme

Arrays = dict[str, np.ndarray]
Methods = tuple[MethodPlan, ...]


@runtime_checkable
class Cell(Protocol):
    """A piece of work."""

    @property
    def name(self) -> str:
        """Path of its results, without a suffix."""
        ...

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the cells that must be done before."""
        ...

    def work(self, lab: Lab) -> int:
        """About how many windows are described."""
        ...

    def run(self, lab: Lab, progress: Progress) -> Arrays:
        """Do it."""
        ...


def plan(config: Config) -> list[Cell]:
    """All cells of an experiment, none before those that it needs."""
    groups = cascades(config.methods)
    solid = cascades([method for method in config.methods if method.in_3d]) if config.pose else []
    chosen = config.chosen_augmentations
    others = [count for count in config.augmentations if count != chosen]
    places = [
        (dataset.name, group, fold) for dataset in config.datasets for fold in range(config.folds) for group in groups
    ]
    return [
        *(PoseModel(group, chosen) for group in solid),
        *(Pose(tuple(solid), spec, chosen) for spec in (config.pose.test if config.pose else ())),
        *(Grid(dataset, group, chosen, fold) for dataset, group, fold in places),
        *(SeveralStarts(dataset, group, chosen, fold) for dataset, group, fold in places if several(config)),
        *(Times(dataset.name, tuple(groups), chosen) for dataset in config.datasets),
        *(Grid(dataset, group, count, fold) for count in others for dataset, group, fold in places),
    ]


def several(config: Config) -> list[int]:
    """The numbers of initialisations that the grid does not measure."""
    return [count for count in config.initialisations if count > 1]


@dataclass(frozen=True)
class Grid:
    """Train on all folds but one and test on that one: errors after each number of steps (Appendices A, B)."""

    dataset: str
    methods: Methods
    augmentations: int
    fold: int
    needs: ClassVar[tuple[str, ...]] = ()

    @property
    def name(self) -> str:
        """Path of its results."""
        return _path("grid", self.dataset, self.methods, f"a{self.augmentations}", f"fold{self.fold}")

    def work(self, lab: Lab) -> int:
        """Windows described in training and testing."""
        faces = lab.faces[self.dataset]
        tested = len(faces.tested(self.fold))
        learned = (len(faces.records) - tested) * self.augmentations * (1 + self.methods[0].options.mirror)
        return (learned + tested) * lab.config.steps * faces.scheme.count

    def run(self, lab: Lab, progress: Progress) -> Arrays:
        """Errors (steps, faces) and, with the chosen augmentations, fits of the chosen steps and the model, kept."""
        config, faces = lab.config, lab.faces[self.dataset]
        rows = faces.tested(self.fold)
        trained = _train(
            lab, faces.scheme, faces.chosen(faces.learned(self.fold)), self.methods, self.augmentations, progress
        )
        results = evaluate_steps(
            trained.model,
            faces.chosen(rows),
            faces.boxes[rows],
            normaliser=config.normaliser,
            progress=progress,
            read=lab.pictures,
        )
        arrays = {"rows": rows, **_errors(results)}
        if self.augmentations == config.chosen_augmentations:
            lab.save_model(self.name, trained.model)
            best = results[config.chosen_steps - 1]
            arrays["landmarks"] = best.landmarks.astype(np.float32)
            if best.fits.pose is not None:
                arrays["pose"] = best.fits.pose
        return arrays | {"problems": np.array([*trained.problems, *map(str, results[-1].fits.problems)], str)}


@dataclass(frozen=True)
class SeveralStarts:
    """Test the chosen models from several initialisations (Appendix C)."""

    dataset: str
    methods: Methods
    augmentations: int
    fold: int

    @property
    def name(self) -> str:
        """Path of its results."""
        return _path("starts", self.dataset, self.methods, f"fold{self.fold}")

    @property
    def needs(self) -> tuple[str, ...]:
        """The cell that trains the model."""
        return (Grid(self.dataset, self.methods, self.augmentations, self.fold).name,)

    def work(self, lab: Lab) -> int:
        """Windows described."""
        faces, config = lab.faces[self.dataset], lab.config
        return len(faces.tested(self.fold)) * sum(several(config)) * config.chosen_steps * faces.scheme.count

    def run(self, lab: Lab, progress: Progress) -> Arrays:
        """Errors (counts, faces); those of a single start are the grid's."""
        config, faces = lab.config, lab.faces[self.dataset]
        rows, model = faces.tested(self.fold), _chosen(lab, self.needs[0])
        results = [
            evaluate(
                model,
                faces.chosen(rows),
                faces.boxes[rows],
                normaliser=config.normaliser,
                starts=Starts(count),
                progress=progress,
                read=lab.pictures,
            )
            for count in several(config)
        ]
        return {"rows": rows, **_errors(results)}


@dataclass(frozen=True)
class Times:
    """Time the chosen models of the first fold, one after the other, again and again (Tables 4 and 6)."""

    dataset: str
    groups: tuple[Methods, ...]
    augmentations: int

    @property
    def name(self) -> str:
        """Path of its results."""
        return f"times/{self.dataset}"

    @property
    def needs(self) -> tuple[str, ...]:
        """The cells that train the models."""
        return tuple(Grid(self.dataset, group, self.augmentations, 0).name for group in self.groups)

    def work(self, lab: Lab) -> int:
        """Windows described."""
        config, faces = lab.config, lab.faces[self.dataset]
        each = min(config.timed_faces, len(faces.tested(0))) * config.chosen_steps * faces.scheme.count
        return each * config.repetitions * len(config.methods)

    def run(self, lab: Lab, progress: Progress) -> Arrays:
        """Seconds a face (repetitions,) of each method: cropping and fitting, from pictures in memory, compiled."""
        config, faces = lab.config, lab.faces[self.dataset]
        rows, pictures = [], []
        for row in faces.tested(0):
            with suppress(ImageError):  # the grid tells
                pictures.append(lab.pictures(faces.records[row].image))
                rows.append(row)
            if len(rows) == config.timed_faces:
                break
        if not rows:
            raise InputError(f"{self.dataset}: no picture of the first fold can be read, to time methods on")
        boxes = faces.boxes[np.array(rows)]
        models = {}
        for group, name in zip(self.groups, self.needs, strict=True):
            for method in group:
                model = _chosen(lab, name)
                models[method.name] = model if method.in_3d else replace(model, aligned=None)
                fit(models[method.name], pictures, boxes)
        seconds: dict[str, list[float]] = {name: [] for name in models}
        for repetition in range(config.repetitions):
            progress("timing", repetition, config.repetitions)
            for name, model in models.items():
                begin = time.perf_counter()
                fit(model, pictures, boxes)
                seconds[name].append((time.perf_counter() - begin) / len(rows))
        told = {f"{name}.seconds": np.array(values) for name, values in seconds.items()}
        return told | {"cores": np.array(os.cpu_count()), "faces": np.array(len(rows))}


@dataclass(frozen=True)
class PoseModel:
    """Train 3D methods on everything that the test of pose names."""

    methods: Methods
    augmentations: int
    needs: ClassVar[tuple[str, ...]] = ()

    @property
    def name(self) -> str:
        """Path of its results."""
        return _path("pose-models", "", self.methods)

    def work(self, lab: Lab) -> int:
        """Windows described."""
        learned = len(lab.pose.learned) * self.augmentations * (1 + self.methods[0].options.mirror)
        return learned * lab.config.steps * lab.pose.scheme.count

    def run(self, lab: Lab, progress: Progress) -> Arrays:
        """The model is kept; the result is how many faces it learned from."""
        trained = _train(lab, lab.pose.scheme, list(lab.pose.learned), self.methods, self.augmentations, progress)
        lab.save_model(self.name, trained.model)
        return {"faces": np.array(trained.faces), "problems": np.array(trained.problems, str)}


@dataclass(frozen=True)
class Pose:
    """Test the pose that 3D methods find (Table 7, Appendices D and E)."""

    groups: tuple[Methods, ...]
    spec: str
    augmentations: int

    @property
    def name(self) -> str:
        """Path of its results."""
        return f"pose/{parse_spec(self.spec)[0]}"

    @property
    def needs(self) -> tuple[str, ...]:
        """The cells that train the models."""
        return tuple(PoseModel(group, self.augmentations).name for group in self.groups)

    def work(self, lab: Lab) -> int:
        """Windows described."""
        tested = len(lab.pose.tested[self.spec].faces)
        return tested * lab.config.chosen_steps * lab.pose.scheme.count * len(self.groups)

    def run(self, lab: Lab, progress: Progress) -> Arrays:
        """Poses (faces, 3) of each method and the true ones, in the order of the labels."""
        dataset = lab.pose.tested[self.spec]
        models = {
            method.name: _chosen(lab, name)
            for group, name in zip(self.groups, self.needs, strict=True)
            for method in group
        }
        results = evaluate_pose(models, dataset, lab.config.seed, progress)
        first = next(iter(results.values()))
        problems = [
            *dataset.problems,
            *(str(problem) for result in results.values() for problem in result.fits.problems),
        ]
        return {
            **{f"{name}.pose": result.ordered_pose for name, result in results.items()},
            "pose": first.true_pose,
            "subject": np.array([face.subject for face in first.faces]),
            "problems": np.array(problems, str),
        }


def _path(kind: str, dataset: str, methods: Methods, *rest: str) -> str:
    names = "+".join(method.name for method in methods)
    return "/".join(part for part in (kind, dataset, names, *rest) if part)


def _chosen(lab: Lab, name: str) -> Model:
    """The model that a cell kept, of the chosen number of steps."""
    model = lab.load_model(name)
    return replace(model, cascade=first_steps(model.cascade, lab.config.chosen_steps))


def _train(
    lab: Lab,
    scheme: Scheme,
    faces: list[FaceRecord],
    methods: Methods,
    augmentations: int,
    progress: Progress,
) -> Trained:
    """The model that serves all methods of a group."""
    method = max(methods, key=lambda method: method.in_3d)  # tells all that the others do
    mirror = method.options.mirror and scheme.mirror is not None
    options = method.options.but(augmentations=augmentations, mirror=mirror)
    return train(faces, scheme, method=method.method, options=options, progress=progress, read=lab.pictures)


def _errors(results: list[Evaluation]) -> Arrays:
    """Errors (evaluations, faces), in 3D too if there are such."""
    arrays = {"errors": np.stack([result.errors for result in results])}
    if results[0].errors_3d is not None:
        arrays["errors_3d"] = np.stack([result.errors_3d for result in results if result.errors_3d is not None])
    return arrays
