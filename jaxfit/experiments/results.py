"""What an experiment has found so far, put together from its cells."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxfit.errors import InputError
from jaxfit.experiments.cells import Cell, Grid, Pose, SeveralStarts, Times, plan, several
from jaxfit.experiments.config import Config, MethodPlan, config_from
from jaxfit.experiments.lab import load_arrays
from jaxfit.experiments.running import OF_FACES, SETTINGS
from jaxfit.schemes.known import scheme_named
from jaxfit.schemes.scheme import Scheme

Arrays = Mapping[str, np.ndarray]


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
        seconds: by method, (repetitions,) seconds a face; empty if not yet timed.
        timed: how the timing was done: ``faces`` and ``cores``; empty if not yet.
    """

    name: str
    thesis: str | None
    scheme: Scheme
    faces: Arrays
    grid: Mapping[str, np.ndarray]
    starts: Mapping[str, np.ndarray]
    fits: Mapping[str, np.ndarray]
    seconds: Mapping[str, np.ndarray]
    timed: Mapping[str, float]

    @property
    def subjects(self) -> np.ndarray:
        """(N,) who is seen."""
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
        subjects: (N,) who is seen.
    """

    name: str
    truth: np.ndarray
    fitted: Mapping[str, np.ndarray]
    subjects: np.ndarray

    @property
    def told(self) -> str:
        """Its name, and how much it tells."""
        return f"{self.name} ({len(self.truth)} pictures of {len(np.unique(self.subjects))} subjects)"


@dataclass(frozen=True)
class Results:
    """Everything.

    Attributes:
        config: what was asked for.
        datasets: in its order.
        pose: likewise.
        cells: number of cells.
        missing: how many of them are not run yet.
        waiting: how many of the others are left out until all folds are run.
        hours: that the others took, of one process.
        made_with: versions and machines that did that.
        problems: what went wrong in them, each once.
    """

    config: Config
    datasets: tuple[DatasetResults, ...]
    pose: tuple[PoseResults, ...]
    cells: int
    missing: int
    waiting: int
    hours: float
    made_with: tuple[str, ...]
    problems: tuple[str, ...]


def read_results(folder: Path) -> Results:
    """The results in the folder of an experiment.

    Raises:
        InputError: there is no experiment, or a file is damaged.
    """
    if not (folder / SETTINGS).is_file():
        raise InputError(f"{folder}: expected results of jaxfit experiments run, found none; check the path")
    values = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))
    config = config_from({key: value for key, value in values.items() if key not in OF_FACES})
    cells = plan(config)
    done = {
        cell.name: (cell, load_arrays(path))
        for cell in cells
        if (path := folder / "cells" / f"{cell.name}.npz").exists()
    }
    whole = {name: kept for name, kept in done.items() if _all_folds(kept[0], config, done)}
    datasets = []
    for dataset in config.datasets:
        found = _Found(config, load_arrays(folder / "datasets" / f"{dataset.name}.npz"))
        for cell, arrays in whole.values():
            if not isinstance(cell, Pose) and getattr(cell, "dataset", None) == dataset.name:
                found.add(cell, arrays)
        datasets.append(
            DatasetResults(
                dataset.name,
                dataset.thesis,
                found.scheme,
                found.faces,
                found.grid,
                found.starts,
                found.fits,
                found.seconds,
                found.timed,
            )
        )
    pose = tuple(
        PoseResults(
            cell.name.partition("/")[2],
            arrays["pose"],
            {method.name: arrays[f"{method.name}.pose"] for group in cell.groups for method in group},
            arrays["subject"],
        )
        for cell, arrays in done.values()
        if isinstance(cell, Pose)
    )
    told = [*(dataset.faces for dataset in datasets), *(arrays for _, arrays in done.values())]
    problems = dict.fromkeys(str(why) for arrays in told for why in arrays.get("problems", ()))
    hours = sum(float(arrays["seconds"]) for _, arrays in done.values()) / 3600
    made_with = dict.fromkeys(str(arrays["made_with"]) for _, arrays in done.values() if "made_with" in arrays)
    return Results(
        config,
        tuple(datasets),
        pose,
        len(cells),
        len(cells) - len(done),
        len(done) - len(whole),
        hours,
        tuple(made_with),
        tuple(problems),
    )


def _all_folds(cell: Cell, config: Config, done: Collection[str]) -> bool:
    """Whether what a cell measures is measured in all folds, and so on all faces."""
    if not isinstance(cell, Grid | SeveralStarts):
        return True
    return all(replace(cell, fold=fold).name in done for fold in range(config.folds))


class _Found:
    """The results of one dataset, filled cell by cell."""

    def __init__(self, config: Config, faces: Arrays):
        self.faces = faces
        self.scheme = scheme_named(str(faces["scheme"]))
        names, count = [method.name for method in config.methods], len(faces["face"])
        sizes = (config.steps, len(config.augmentations), count)
        self.config = config
        self.grid = {name: np.full(sizes, np.nan) for name in names}
        self.starts = {name: np.full((len(config.initialisations), count), np.nan) for name in names}
        self.fits = {name: np.full((count, self.scheme.count, 2), np.nan) for name in names}
        self.seconds = {name: np.empty(0) for name in names}
        self.timed: dict[str, float] = {}

    def add(self, cell: object, arrays: Arrays) -> None:
        """Put a cell's results where they belong."""
        if isinstance(cell, Times):
            self.seconds = {name: arrays[f"{name}.seconds"] for name in self.seconds}
            self.timed = {key: float(arrays[key]) for key in ("faces", "cores")}
            return
        assert isinstance(cell, Grid | SeveralStarts), "no other cells are of a dataset"
        rows = arrays["rows"]
        for method in cell.methods:
            errors = arrays["errors_3d" if method.in_3d else "errors"]
            if isinstance(cell, SeveralStarts):
                at = [self.config.initialisations.index(count) for count in several(self.config)]
                self.starts[method.name][np.ix_(np.array(at), rows)] = errors
                continue
            column = self.config.augmentations.index(cell.augmentations)
            self.grid[method.name][:, column, rows] = errors
            if cell.augmentations == self.config.chosen_augmentations:
                self.fits[method.name][rows] = arrays["landmarks"]
                if 1 in self.config.initialisations:
                    single = self.config.initialisations.index(1)
                    self.starts[method.name][single, rows] = errors[self.config.chosen_steps - 1]
