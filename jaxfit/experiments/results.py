"""What an experiment has found so far, put together from the results of its tasks."""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxfit.errors import InputError
from jaxfit.experiments.arrays import Arrays, load_arrays
from jaxfit.experiments.config import Config, DatasetPlan, MethodPlan, config_from
from jaxfit.experiments.experiment import FACE_SETTINGS, SETTINGS, faces_file, result_file
from jaxfit.experiments.tasks import GridTask, PoseTask, StartsTask, Task, TimesTask, plan_tasks, several_starts
from jaxfit.schemes.own import read_scheme_text
from jaxfit.schemes.scheme import Scheme


@dataclass(frozen=True)
class DatasetResults:
    """What is known of the methods on one dataset's N faces; errors of 3D methods are those in 3D.

    Attributes:
        name: of the dataset.
        thesis: its counterpart in the thesis, or None.
        scheme: what landmarks mean.
        faces: arrays of N: ``face``, ``subject``, ``image`` (paths), ``box``, ``landmarks``, ``pose``, ``fold``.
        grid: by method, (steps, augmentations, N) errors; ``inf`` is a failure, NaN not measured or not yet run. Where
            a fold is not yet run, no face has an error: all methods are compared on the same faces.
        starts: by method, (initialisations, N) errors, likewise.
        fits: by method, (N, L, 2) landmarks that the chosen models find in 2D, NaN where there are none. Those of 3D
            alignment are what it aligns the head to.
        learned: by method, (N,) from whose pictures the models learned that tested them, 0 or 1; NaN unknown.
        seconds: by method, (repetitions,) seconds a face; empty if not yet timed.
        timed: how the timing was done: ``faces`` and ``cores``; empty if not yet.
    """

    name: str
    thesis: str | None
    scheme: Scheme
    faces: Mapping[str, np.ndarray]
    grid: Mapping[str, np.ndarray]
    starts: Mapping[str, np.ndarray]
    fits: Mapping[str, np.ndarray]
    learned: Mapping[str, np.ndarray]
    seconds: Mapping[str, np.ndarray]
    timed: Mapping[str, float]

    @property
    def subjects(self) -> np.ndarray:
        """(N,) who is on each picture."""
        return self.faces["subject"]

    def errors(self, method: str, config: Config) -> np.ndarray:
        """(N,) errors of the chosen models."""
        chosen = config.augmentations.index(config.chosen_augmentations)
        return self.grid[method][config.chosen_steps - 1, chosen]

    def tested(self, plans: Sequence[MethodPlan], config: Config) -> list[MethodPlan]:
        """Those methods whose chosen models were tested."""
        return [plan for plan in plans if not np.isnan(self.errors(plan.name, config)).all()]


@dataclass(frozen=True)
class PoseResults:
    """Poses that 3D methods found, in degrees.

    Attributes:
        name: of the dataset.
        truth: (N, 3) labelled roll, pitch and yaw.
        fitted: by method, (N, 3).
        subjects: (N,) who is on each picture.
    """

    name: str
    truth: np.ndarray
    fitted: Mapping[str, np.ndarray]
    subjects: np.ndarray

    @property
    def title(self) -> str:
        """Its name, and of how many pictures and people it is."""
        return f"{self.name} ({len(self.truth)} pictures of {len(np.unique(self.subjects))} subjects)"


@dataclass(frozen=True)
class ExperimentResults:
    """The results of all tasks that are done.

    Attributes:
        config: what was asked for.
        datasets: in its order.
        pose: likewise.
        tasks: how many there are.
        missing: how many of them are not run yet.
        waiting: how many of the others are left out until all folds are run.
        hours: that the others took, of one process.
        made_with: versions and machines that did that.
        problems: what went wrong in them, each once.
    """

    config: Config
    datasets: tuple[DatasetResults, ...]
    pose: tuple[PoseResults, ...]
    tasks: int
    missing: int
    waiting: int
    hours: float
    made_with: tuple[str, ...]
    problems: tuple[str, ...]


_Done = Mapping[str, tuple[Task, Arrays]]  # tasks and their results, by name


def read_results(folder: Path) -> ExperimentResults:
    """The results in the folder of an experiment.

    Raises:
        InputError: there is no experiment, or a file is damaged.
    """
    if not (folder / SETTINGS).is_file():
        raise InputError(f"{folder}: expected results of jaxfit experiments run, found none; check the path")
    values = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))
    config = config_from({key: value for key, value in values.items() if key not in FACE_SETTINGS})
    tasks = plan_tasks(config)
    done: _Done = {
        task.name: (task, load_arrays(path)) for task in tasks if (path := result_file(folder, task.name)).exists()
    }
    complete = {name: kept for name, kept in done.items() if _all_folds(kept[0], config, done)}
    datasets = tuple(
        _dataset_results(config, dataset, load_arrays(faces_file(folder, dataset.name)), complete)
        for dataset in config.datasets
    )
    arrays = [*(dataset.faces for dataset in datasets), *(arrays for _, arrays in done.values())]
    return ExperimentResults(
        config=config,
        datasets=datasets,
        pose=tuple(_pose_results(done)),
        tasks=len(tasks),
        missing=len(tasks) - len(done),
        waiting=len(done) - len(complete),
        hours=sum(float(arrays["seconds"]) for _, arrays in done.values()) / 3600,
        made_with=_texts("made_with", arrays),
        problems=_texts("problems", arrays),
    )


def _all_folds(task: Task, config: Config, done: Collection[str]) -> bool:
    """Whether what a task measures is measured in all folds, and so on all faces."""
    if not isinstance(task, GridTask | StartsTask):
        return True
    return all(replace(task, fold=fold).name in done for fold in range(config.folds))


def _dataset_results(config: Config, dataset: DatasetPlan, faces: Arrays, done: _Done) -> DatasetResults:
    """The results of one dataset."""
    scheme, count = read_scheme_text(str(faces["scheme"])), len(faces["face"])

    def unknown(*shape: int) -> dict[str, np.ndarray]:
        return {method.name: np.full(shape, np.nan) for method in config.methods}

    grid = unknown(config.steps, len(config.augmentations), count)
    starts, fits = unknown(len(config.initialisations), count), unknown(count, scheme.count, 2)
    learned = unknown(count)
    seconds, timed = {method.name: np.empty(0) for method in config.methods}, {}
    several = [config.initialisations.index(number) for number in several_starts(config)]
    for task, arrays in done.values():
        if isinstance(task, TimesTask) and task.dataset == dataset.name:
            seconds = {name: arrays[f"{name}.seconds"] for name in seconds}
            timed = {key: float(arrays[key]) for key in ("faces", "cores")}
        if not isinstance(task, GridTask | StartsTask) or task.dataset != dataset.name:
            continue
        rows = arrays["rows"]
        for method in task.methods:
            errors = arrays["errors_3d" if method.in_3d else "errors"]
            if isinstance(task, StartsTask):
                starts[method.name][np.ix_(np.array(several), rows)] = errors
                continue
            grid[method.name][:, config.augmentations.index(task.augmentations), rows] = errors
            if task.augmentations == config.chosen_augmentations:
                fits[method.name][rows] = arrays["landmarks"]
                learned[method.name][rows] = arrays.get("learned", np.nan)
                if 1 in config.initialisations:
                    single = config.initialisations.index(1)
                    starts[method.name][single, rows] = errors[config.chosen_steps - 1]
    return DatasetResults(dataset.name, dataset.thesis, scheme, faces, grid, starts, fits, learned, seconds, timed)


def _pose_results(done: _Done) -> Iterator[PoseResults]:
    for task, arrays in done.values():
        if isinstance(task, PoseTask):
            fitted = {method.name: arrays[f"{method.name}.pose"] for group in task.groups for method in group}
            yield PoseResults(task.dataset, arrays["pose"], fitted, arrays["subject"])


def _texts(name: str, results: Sequence[Mapping[str, np.ndarray]]) -> tuple[str, ...]:
    """The texts of that name in all results, each once."""
    return tuple(dict.fromkeys(str(text) for arrays in results for text in np.ravel(arrays.get(name, ()))))
