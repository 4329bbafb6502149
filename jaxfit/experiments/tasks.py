"""The tasks of an experiment: pieces of work with a name, whose results are arrays; each can run once those it needs
have results.

What tasks share is exact. One training serves all numbers of steps, because each step is learned after those before it
and does not depend on those after; and it serves both the parametric method and 3D alignment, which learn the same
cascade. Trainings of different augmentations, folds or datasets share nothing but the pictures in memory: already their
second steps see different windows.
"""

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from jaxfit.cascade.model import first_steps
from jaxfit.cascade.starts import Starts
from jaxfit.errors import ImageError, InputError
from jaxfit.evaluation.evaluate import Evaluation, evaluate, evaluate_steps
from jaxfit.experiments.arrays import Arrays
from jaxfit.experiments.config import Config, MethodPlan
from jaxfit.experiments.experiment import Experiment
from jaxfit.fitting.fit import fit
from jaxfit.labels.datasets import parse_spec
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.methods import METHODS, Options, view_of
from jaxfit.learning.placements import evaluate_pose
from jaxfit.learning.train import Trained, train
from jaxfit.models.model import Model
from jaxfit.schemes.scheme import Scheme
from jaxfit.types import Progress, silent

Methods = tuple[MethodPlan, ...]


@runtime_checkable
class Task(Protocol):
    """A piece of work."""

    @property
    def name(self) -> str:
        """Path of its results, without a suffix."""
        ...

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the tasks that must be done before."""
        ...

    def work(self, experiment: Experiment) -> int:
        """About how many windows are described."""
        ...

    def run(self, experiment: Experiment, progress: Progress) -> Arrays:
        """Do it."""
        ...


def plan_tasks(config: Config) -> list[Task]:
    """All tasks of an experiment, none before those that it needs."""
    groups = shared_trainings(config.methods)
    groups_3d = shared_trainings([method for method in config.methods if method.in_3d]) if config.pose else []
    chosen = config.chosen_augmentations
    others = [count for count in config.augmentations if count != chosen]
    places = [
        (dataset.name, group, fold) for dataset in config.datasets for fold in range(config.folds) for group in groups
    ]
    return [
        *(PoseModelTask(group, chosen) for group in groups_3d),
        *(PoseTask(tuple(groups_3d), spec, chosen) for spec in (config.pose.test if config.pose else ())),
        *(GridTask(dataset, group, chosen, fold) for dataset, group, fold in places),
        *(StartsTask(dataset, group, chosen, fold) for dataset, group, fold in places if several_starts(config)),
        *(TimesTask(dataset.name, tuple(groups), chosen) for dataset in config.datasets),
        *(GridTask(dataset, group, count, fold) for count in others for dataset, group, fold in places),
    ]


def several_starts(config: Config) -> list[int]:
    """The numbers of initialisations that the grid does not measure."""
    return [count for count in config.initialisations if count > 1]


def shared_trainings(methods: Sequence[MethodPlan]) -> list[Methods]:
    """Methods that one training serves, together: 3D alignment learns the cascade of the parametric method."""
    groups: list[list[MethodPlan]] = []
    for plan in methods:
        for group in groups:
            head_models = {other.options.head_model for other in [*group, plan] if other.in_3d}
            if len(head_models) <= 1 and _cascade(plan) == _cascade(group[0]):
                group.append(plan)
                break
        else:
            groups.append([plan])
    return [tuple(group) for group in groups]


def _cascade(plan: MethodPlan) -> tuple[object, Options]:
    """What decides on the cascade that a method learns."""
    descriptor, frame = view_of(plan.method, plan.options)
    return METHODS[plan.method].learn_space, plan.options.but(descriptor=descriptor, frame=frame, head_model="")


@dataclass(frozen=True)
class GridTask:
    """Train on all folds but one and test on that one: errors after each number of steps."""

    dataset: str
    methods: Methods
    augmentations: int
    fold: int
    needs: ClassVar[tuple[str, ...]] = ()

    @property
    def name(self) -> str:
        """Path of its results."""
        return _path("grid", self.dataset, self.methods, f"a{self.augmentations}", f"fold{self.fold}")

    def work(self, experiment: Experiment) -> int:
        """Windows described in training and testing."""
        faces = experiment.faces[self.dataset]
        tested = len(faces.tested(self.fold))
        learned = (len(faces.records) - tested) * self.augmentations * (1 + self.methods[0].options.mirror)
        return (learned + tested) * experiment.config.steps * faces.scheme.count

    def train_few(self, experiment: Experiment, count: int) -> None:
        """Train as this task does, on some of the faces and from one start each, which takes only the time of
        compiling."""
        faces = experiment.faces[self.dataset]
        few = faces.chosen(faces.learned(self.fold)[:count])
        _train(experiment, faces.scheme, few, self.methods, 1, silent)

    def run(self, experiment: Experiment, progress: Progress) -> Arrays:
        """Errors (steps, faces) and, with the chosen augmentations, fits of the chosen steps and the model, kept."""
        config, faces = experiment.config, experiment.faces[self.dataset]
        rows, learned = faces.tested(self.fold), faces.chosen(faces.learned(self.fold))
        trained = _train(experiment, faces.scheme, learned, self.methods, self.augmentations, progress)
        results = evaluate_steps(
            trained.model,
            faces.chosen(rows),
            faces.boxes[rows],
            normaliser=config.normaliser,
            progress=progress,
            read=experiment.pictures,
        )
        arrays = {"rows": rows, **_errors(results)}
        if self.augmentations == config.chosen_augmentations:
            experiment.save_model(self.name, trained.model)
            best = results[config.chosen_steps - 1]
            arrays["landmarks"] = best.landmarks.astype(np.float32)
            if best.learned is not None:
                arrays["learned"] = best.learned
            if best.fits.pose is not None:
                arrays["pose"] = best.fits.pose
        return arrays | {"problems": np.array([*trained.problems, *map(str, results[-1].fits.problems)], str)}


@dataclass(frozen=True)
class StartsTask:
    """Test the chosen models from several initialisations."""

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
        """The task that trains the model."""
        return (GridTask(self.dataset, self.methods, self.augmentations, self.fold).name,)

    def work(self, experiment: Experiment) -> int:
        """Windows described."""
        faces, config = experiment.faces[self.dataset], experiment.config
        return len(faces.tested(self.fold)) * sum(several_starts(config)) * config.chosen_steps * faces.scheme.count

    def run(self, experiment: Experiment, progress: Progress) -> Arrays:
        """Errors (counts, faces); those of a single start are the grid's."""
        config, faces = experiment.config, experiment.faces[self.dataset]
        rows, model = faces.tested(self.fold), _chosen_model(experiment, self.needs[0])
        results = [
            evaluate(
                model,
                faces.chosen(rows),
                faces.boxes[rows],
                normaliser=config.normaliser,
                starts=Starts(count),
                progress=progress,
                read=experiment.pictures,
            )
            for count in several_starts(config)
        ]
        return {"rows": rows, **_errors(results)}


@dataclass(frozen=True)
class TimesTask:
    """Time the chosen models of the first fold, one after the other, again and again."""

    dataset: str
    groups: tuple[Methods, ...]
    augmentations: int

    @property
    def name(self) -> str:
        """Path of its results."""
        return f"times/{self.dataset}"

    @property
    def needs(self) -> tuple[str, ...]:
        """The tasks that train the models."""
        return tuple(GridTask(self.dataset, group, self.augmentations, 0).name for group in self.groups)

    def work(self, experiment: Experiment) -> int:
        """Windows described."""
        config, faces = experiment.config, experiment.faces[self.dataset]
        each = min(config.timed_faces, len(faces.tested(0))) * config.chosen_steps * faces.scheme.count
        return each * config.repetitions * len(config.methods)

    def run(self, experiment: Experiment, progress: Progress) -> Arrays:
        """Seconds a face (repetitions,) of each method: cropping and fitting, from pictures in memory, compiled."""
        config, faces = experiment.config, experiment.faces[self.dataset]
        rows, pictures = [], []
        for row in faces.tested(0):
            with suppress(ImageError):  # the grid reports it
                pictures.append(experiment.pictures(faces.records[row].image))
                rows.append(row)
            if len(rows) == config.timed_faces:
                break
        if not rows:
            raise InputError(f"{self.dataset}: no picture of the first fold can be read, to time methods on")
        boxes = faces.boxes[np.array(rows)]
        models = {}
        for group, name in zip(self.groups, self.needs, strict=True):
            for method in group:
                model = _chosen_model(experiment, name)
                models[method.name] = model if method.in_3d else replace(model, aligned=None)
                fit(models[method.name], pictures, boxes)
        seconds: dict[str, list[float]] = {name: [] for name in models}
        for repetition in range(config.repetitions):
            progress("timing", repetition, config.repetitions)
            for name, model in models.items():
                begin = time.perf_counter()
                fit(model, pictures, boxes)
                seconds[name].append((time.perf_counter() - begin) / len(rows))
        measured = {f"{name}.seconds": np.array(values) for name, values in seconds.items()}
        return measured | {"cores": np.array(os.cpu_count()), "faces": np.array(len(rows))}


@dataclass(frozen=True)
class PoseModelTask:
    """Train 3D methods on everything that the test of pose names."""

    methods: Methods
    augmentations: int
    needs: ClassVar[tuple[str, ...]] = ()

    @property
    def name(self) -> str:
        """Path of its results."""
        return _path("pose-models", "", self.methods)

    def work(self, experiment: Experiment) -> int:
        """Windows described."""
        learned = len(experiment.pose.learned) * self.augmentations * (1 + self.methods[0].options.mirror)
        return learned * experiment.config.steps * experiment.pose.scheme.count

    def run(self, experiment: Experiment, progress: Progress) -> Arrays:
        """The model is kept; the result is how many faces it learned from."""
        pose = experiment.pose
        trained = _train(experiment, pose.scheme, pose.learned, self.methods, self.augmentations, progress)
        experiment.save_model(self.name, trained.model)
        return {"faces": np.array(trained.faces), "problems": np.array(trained.problems, str)}


@dataclass(frozen=True)
class PoseTask:
    """Test the pose that 3D methods find."""

    groups: tuple[Methods, ...]
    spec: str
    augmentations: int

    @property
    def dataset(self) -> str:
        """Name of the dataset that is tested on: its format."""
        return parse_spec(self.spec)[0]

    @property
    def name(self) -> str:
        """Path of its results."""
        return f"pose/{self.dataset}"

    @property
    def needs(self) -> tuple[str, ...]:
        """The tasks that train the models."""
        return tuple(PoseModelTask(group, self.augmentations).name for group in self.groups)

    def work(self, experiment: Experiment) -> int:
        """Windows described."""
        tested = len(experiment.pose.tested[self.spec].faces)
        return tested * experiment.config.chosen_steps * experiment.pose.scheme.count * len(self.groups)

    def run(self, experiment: Experiment, progress: Progress) -> Arrays:
        """Poses (faces, 3) of each method and the true ones, in the order of the labels."""
        dataset = experiment.pose.tested[self.spec]
        models = {
            method.name: _chosen_model(experiment, name)
            for group, name in zip(self.groups, self.needs, strict=True)
            for method in group
        }
        results = evaluate_pose(models, dataset, experiment.config.seed, progress=progress)
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


def _chosen_model(experiment: Experiment, name: str) -> Model:
    """The model that a task kept, of the chosen number of steps."""
    model = experiment.load_model(name)
    return replace(model, cascade=first_steps(model.cascade, experiment.config.chosen_steps))


def _train(
    experiment: Experiment,
    scheme: Scheme,
    faces: Sequence[FaceRecord],
    methods: Methods,
    augmentations: int,
    progress: Progress,
) -> Trained:
    """The model that serves all methods of a group."""
    method = max(methods, key=lambda method: method.in_3d)  # finds all that the others do
    mirror = method.options.mirror and scheme.mirror is not None
    options = method.options.but(augmentations=augmentations, mirror=mirror)
    return train(faces, scheme, method=method.method, options=options, progress=progress, read=experiment.pictures)


def _errors(results: Sequence[Evaluation]) -> Arrays:
    """Errors (evaluations, faces), in 3D too if there are such."""
    arrays = {"errors": np.stack([result.errors for result in results])}
    if results[0].errors_3d is not None:
        arrays["errors_3d"] = np.stack([result.errors_3d for result in results if result.errors_3d is not None])
    return arrays
