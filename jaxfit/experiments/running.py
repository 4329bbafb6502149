"""Running an experiment: cell after cell, in one process or several, and on where a killed run ended."""

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
from jaxfit.data.outputs import require_same_settings
from jaxfit.errors import InputError, JaxfitError
from jaxfit.experiments.cells import Cell, plan
from jaxfit.experiments.config import Config
from jaxfit.experiments.lab import Lab
from jaxfit.models.files import load

# What an experiment's folder says that it is.
SETTINGS = "config.json"
# What it says of the faces beside the configuration: how many, and a digest of their labels and folds.
OF_FACES = ("faces", "labels")
# Seconds between looks at what other processes do.
_PATIENCE = 2.0
# Training takes some more than describing windows.
_BEYOND_WINDOWS = 1.3
# No two trainings keep equally many components: their compiled code piles up, by some 200 MB a cell.
_CELLS_COMPILED = 8
_PROBE, _PROBED = "sdm68", 16


@dataclass(frozen=True)
class Standing:
    """How far an experiment is.

    Attributes:
        cells: in all.
        done: of them.
        work_left: of the others, in windows.
        seconds_left: that these take one process; NaN if nothing tells yet.
    """

    cells: int
    done: int
    work_left: int
    seconds_left: float


def run(
    config: Config,
    folder: Path,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
    begun: Callable[[Cell, Standing], None] = lambda cell, standing: None,
) -> None:
    """Do all cells of an experiment that are not done; several processes may do so at once, in the same folder.

    A cell's results are the same whenever and wherever on the same machine it is run, except for times.

    Args:
        config: what is run.
        folder: where results are kept.
        progress: called with the stage's name, what is done and what there is to do within a cell.
        begun: called with each cell before it is run, and how far the experiment is.

    Raises:
        InputError: the folder holds results of another configuration, something needed is not there, or a cell failed:
            all others that do not need it are done before that is told.
        DatasetError: a dataset cannot be read.
    """
    lab = Lab(config, folder)
    keep_settings(lab)
    lab.write_faces()
    waiting, ran = plan(config), 0
    failed: dict[str, JaxfitError] = {}
    while waiting := [
        cell
        for cell in waiting
        if not lab.result(cell.name).exists() and failed.keys().isdisjoint((cell.name, *cell.needs))
    ]:
        before = ran + len(failed)
        for cell in waiting:
            if lab.result(cell.name).exists() or not all(lab.result(name).exists() for name in cell.needs):
                continue
            with _alone(lab, cell) as alone:
                if not alone or lab.result(cell.name).exists():
                    continue
                begun(cell, standing(lab))
                begin = time.perf_counter()
                try:
                    arrays = cell.run(lab, progress)
                except JaxfitError as error:
                    failed[cell.name] = error
                    continue
                seconds = np.array(time.perf_counter() - begin)
                told = {"seconds": seconds, "work": np.array(cell.work(lab)), "made_with": np.array(_made_with())}
                lab.save_result(cell.name, {**arrays, **told})
                ran += 1
                if ran % _CELLS_COMPILED == 0:
                    jax.clear_caches()
        if ran + len(failed) == before:
            time.sleep(_PATIENCE)  # what is left is being run by others, or waits for them
    if failed:
        whys = "; ".join(f"{name}: {error}" for name, error in failed.items())
        raise InputError(f"these cells failed, and what needs them was not run: {whys}")


def keep_settings(lab: Lab) -> None:
    """Write the configuration into a folder that is new, or check that its results are of the same one.

    Raises:
        InputError: they are of another, or a dataset cannot be read.
        DatasetError: a dataset cannot be read.
    """
    settings = lab.config.as_json()
    # Data may lie elsewhere next time.
    for name, dataset in settings["datasets"].items():
        dataset["data"] = [_folder_name(spec) for spec in dataset["data"]]
        for key, told in zip(OF_FACES, (len(lab.faces[name].records), lab.faces[name].digest), strict=True):
            settings.setdefault(key, {})[name] = told
    for key in ("train", "test") if lab.config.pose else ():
        settings["pose"][key] = [_folder_name(spec) for spec in settings["pose"][key]]
    if lab.config.pose:  # read before hours of training, in case it cannot be
        settings.setdefault("faces", {})["[pose]"] = len(lab.pose.learned)
    lab.folder.mkdir(parents=True, exist_ok=True)
    require_same_settings(lab.folder / SETTINGS, settings)


def standing(lab: Lab) -> Standing:
    """How far an experiment is, and how long the rest takes by the pace of what is done."""
    cells = plan(lab.config)
    costs = {cell.name: lab.cost(cell.name) for cell in cells}
    seconds, work = (sum(each) for each in zip((0.0, 0.0), *filter(None, costs.values()), strict=True))
    left = [cell for cell in cells if costs[cell.name] is None]
    to_do = sum(cell.work(lab) for cell in left)
    return Standing(len(cells), len(cells) - len(left), to_do, to_do * seconds / work if work else float("nan"))


def probe_pace() -> float:
    """Seconds a window takes on this machine, roughly: a bundled model tells."""
    model = load(_PROBE)
    side = model.cascade.frame.crop
    crops = jnp.zeros((_PROBED, side, side), jnp.uint8)
    jax.block_until_ready(fit_crops(model.cascade, crops))
    begin = time.perf_counter()
    jax.block_until_ready(fit_crops(model.cascade, crops))
    windows = _PROBED * len(model.cascade.windows) * model.scheme.count
    return _BEYOND_WINDOWS * (time.perf_counter() - begin) / windows


@contextmanager
def _alone(lab: Lab, cell: Cell) -> Iterator[bool]:
    """Whether no other process runs the cell; while this lasts none will. The system frees what a killed one held."""
    try:
        from filelock import FileLock, Timeout
    except ImportError as error:
        raise InputError('experiments need filelock: pip install "jaxfit[experiments]"') from error
    path = lab.folder / "locks" / f"{cell.name.replace('/', '-')}.lock"
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


def _folder_name(spec: str) -> str:
    form, _, path = spec.partition(":")
    return f"{form}:{Path(path).name}"
