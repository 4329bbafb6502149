"""Running an experiment: task after task, in one process or several; a killed run goes on where it ended."""

import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jax import numpy as jnp

import jaxfit
from jaxfit.cascade.fit import fit_crops
from jaxfit.errors import InputError, JaxfitError
from jaxfit.experiments.config import Config
from jaxfit.experiments.experiment import Experiment
from jaxfit.experiments.tasks import GridTask, PoseModelTask, Task, plan_tasks
from jaxfit.models.files import load
from jaxfit.types import Progress, silent

# Seconds between looks at what other processes do.
_PATIENCE = 2.0
# Training takes some more than describing windows.
_BEYOND_WINDOWS = 1.3
# No two trainings keep equally many components: their compiled code piles up, by some 200 MB a task.
_TASKS_COMPILED = 8
# What the pace of this machine is measured with: a bundled model, and on how many crops.
_PACE_MODEL, _PACE_CROPS = "sdm68", 16
_PACE_FACES = 24  # of a training whose time is spent on compiling


@dataclass(frozen=True)
class Status:
    """How far an experiment is.

    Attributes:
        tasks: in all.
        done: of them.
        work_left: of the others, in windows.
        seconds_left: that these take one process, by the pace of those that are done; NaN if none is.
    """

    tasks: int
    done: int
    work_left: int
    seconds_left: float


def run_experiment(
    config: Config,
    folder: Path,
    *,
    progress: Progress = silent,
    begun: Callable[[Task, Status], None] = lambda task, status: None,
) -> None:
    """Do all tasks of an experiment that are not done; several processes may do so at once, in the same folder.

    A task's results are the same whenever and wherever on the same machine it is run, except for times.

    Args:
        config: what is run.
        folder: where results are kept.
        progress: called with the stage's name, what is done and what there is to do within a task.
        begun: called with each task before it is run, and how far the experiment is.

    Raises:
        InputError: the folder holds results of another configuration, something needed is not there, or a task failed:
            all others that do not need it are done before this error is raised.
        DatasetError: a dataset cannot be read.
    """
    experiment = Experiment(config, folder)
    experiment.keep_settings()
    experiment.write_faces()
    waiting, ran = plan_tasks(config), 0
    failed: dict[str, JaxfitError] = {}
    while waiting := [
        task
        for task in waiting
        if not experiment.done(task.name) and failed.keys().isdisjoint((task.name, *task.needs))
    ]:
        before = ran + len(failed)
        for task in waiting:
            if experiment.done(task.name) or not all(map(experiment.done, task.needs)):
                continue
            with _alone(experiment, task) as alone:
                if not alone or experiment.done(task.name):
                    continue
                begun(task, experiment_status(experiment))
                begin = time.perf_counter()
                try:
                    arrays = task.run(experiment, progress)
                except JaxfitError as error:
                    failed[task.name] = error
                    continue
                seconds = np.array(time.perf_counter() - begin)
                about = {
                    "seconds": seconds,
                    "work": np.array(task.work(experiment)),
                    "made_with": np.array(_made_with()),
                }
                experiment.save_result(task.name, {**arrays, **about})
                ran += 1
                if ran % _TASKS_COMPILED == 0:
                    jax.clear_caches()
        if ran + len(failed) == before:
            time.sleep(_PATIENCE)  # what is left is being run by others, or waits for them
    if failed:
        whys = "; ".join(f"{name}: {error}" for name, error in failed.items())
        raise InputError(f"these tasks failed, and those that need them were not run: {whys}")


def experiment_status(experiment: Experiment) -> Status:
    """How far an experiment is, and how long the rest takes by the pace of what is done.

    Raises:
        InputError: results are damaged.
    """
    tasks = plan_tasks(experiment.config)
    costs = {task.name: experiment.cost(task.name) for task in tasks}
    seconds, work = (sum(each) for each in zip((0.0, 0.0), *filter(None, costs.values()), strict=True))
    left = [task for task in tasks if costs[task.name] is None]
    to_do = sum(task.work(experiment) for task in left)
    return Status(len(tasks), len(tasks) - len(left), to_do, to_do * seconds / work if work else float("nan"))


def seconds_per_window() -> float:
    """Roughly how long a window takes on this machine, as measured with a bundled model."""
    model = load(_PACE_MODEL)
    side = model.cascade.frame.crop
    crops = jnp.zeros((_PACE_CROPS, side, side), jnp.uint8)
    jax.block_until_ready(fit_crops(model.cascade, crops))
    begin = time.perf_counter()
    jax.block_until_ready(fit_crops(model.cascade, crops))
    windows = _PACE_CROPS * len(model.cascade.windows) * model.scheme.count
    return _BEYOND_WINDOWS * (time.perf_counter() - begin) / windows


def seconds_to_compile(experiment: Experiment) -> float:
    """Roughly how long the trainings that are left compile on this machine, as measured with a training on few faces:
    each compiles anew, as no two keep equally many components.

    Raises:
        InputError: the first dataset's faces cannot be learned from.
    """
    left = [task for task in plan_tasks(experiment.config) if not experiment.done(task.name)]
    trainings = sum(isinstance(task, GridTask | PoseModelTask) for task in left)
    first = next((task for task in left if isinstance(task, GridTask)), None)
    if first is None:
        return 0.0
    begin = time.perf_counter()
    first.train_few(experiment, _PACE_FACES)
    return trainings * (time.perf_counter() - begin)


@contextmanager
def _alone(experiment: Experiment, task: Task) -> Iterator[bool]:
    """Whether no other process runs the task; while this lasts none will. The system frees what a killed one held."""
    try:
        from filelock import FileLock, Timeout
    except ImportError as error:
        raise InputError('experiments need filelock: pip install "jaxfit[experiments]"') from error
    path = experiment.folder / "locks" / f"{task.name.replace('/', '-')}.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()


def _made_with() -> str:
    device = jax.devices()[0].device_kind
    versions = f"jaxfit {jaxfit.__version__}, jax {jax.__version__}, numpy {np.__version__}"
    return f"{versions}, {platform.system()}, {platform.machine()}, {device}"
