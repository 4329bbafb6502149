"""What a report says of errors of landmarks: parameters, comparisons, times, the grid and initialisations."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.plots import new_figure, plot_ced
from jaxfit.evaluation.statistics import auc_ci, failure_ci, holm, relative_difference
from jaxfit.evaluation.tables import COMPARISON_COLUMNS, Row, comparison_row, summary_row
from jaxfit.experiments.config import Config, MethodPlan
from jaxfit.experiments.figures import mean_and_ci, plot_grid, plot_starts
from jaxfit.experiments.report_parts import ReportFigure, ReportTable
from jaxfit.experiments.results import DatasetResults, ExperimentResults

_CED_LIMIT = 0.25  # where curves end
_ERRORS = {
    "dataset": "",
    "method": "",
    "faces": "d",
    "learned from": "d",
    "no fit": "d",
    "unmeasured": "d",
    "mean": ".4f",
    "± 95 %": ".4f",
    "median": ".4f",
    f"AUC@{LIMIT:g}": ".3f",
    "AUC from": ".3f",
    "AUC to": ".3f",
    f"failure@{LIMIT:g}": ".1%",
    "failure from": ".1%",
    "failure to": ".1%",
}
DIFFERENCES = {
    "difference of means": "+.1%",
    "± 95 %": ".1%",
    "difference of medians": "+.1%",
    "rank-sum p": ".2g",
    "signed-rank p": ".2g",
    "signed-rank p (Holm)": ".2g",
}


class Group(NamedTuple):
    """Methods that are compared with one another: those whose errors are in 2D, or in 3D."""

    in_3d: bool
    name: str
    plans: tuple[MethodPlan, ...]

    @property
    def error(self) -> str:
        """What is measured."""
        return f"NMED ({self.name})"

    @property
    def stem(self) -> str:
        """Of names of files."""
        return self.name.lower()


def parameters(results: ExperimentResults, group: Group) -> Iterator[ReportTable | ReportFigure]:
    """Errors over steps, augmentations and initialisations, and the best of the grid."""
    config, rows = results.config, []
    for dataset in results.datasets:
        tested = dataset.tested(group.plans, config)
        if not tested:
            continue
        rows += [row for plan in tested for row in _best(dataset, config, plan)]
        grids = {plan.name: dataset.grid[plan.name] for plan in tested}
        yield ReportFigure(
            f"grid-{dataset.name}-{group.stem}",
            f"{dataset.name}: errors over steps and augmentations",
            plot_grid(grids, config.augmentations, group.error, dataset.subjects),
        )
        starts = {plan.name: dataset.starts[plan.name] for plan in tested}
        if len(config.initialisations) > 1 and all(np.isfinite(each).any(1).all() for each in starts.values()):
            yield ReportFigure(
                f"starts-{dataset.name}-{group.stem}",
                f"{dataset.name}: errors over initialisations",
                plot_starts(starts, config.initialisations, group.error, dataset.subjects),
                "Starts turned evenly over -90° to 90°, of models that were trained for one upright start.",
            )
    if rows:
        columns = {"dataset": "", "method": "", "augmentations": "d", "steps": "d", "mean": ".4f"}
        note = (
            "The smallest mean error of the grid, over the faces that all its models fitted, on the faces that are "
            f"tested: what is compared below is not this but {config.chosen_augmentations} augmentations and "
            f"{config.chosen_steps} steps, chosen beforehand."
        )
        yield ReportTable(f"best-{group.stem}", f"Best of the grid ({group.name})", columns, tuple(rows), note)


def _best(dataset: DatasetResults, config: Config, plan: MethodPlan) -> Iterator[Row]:
    """The row of a method, if any face was fitted by all its models."""
    grid = dataset.grid[plan.name]
    run = ~np.isnan(grid).all(2)
    fitted = np.isfinite(grid[run]).all(0)
    if not fitted.any():
        return
    means = np.where(run, grid[..., fitted].mean(2), np.inf)
    step, column = np.unravel_index(np.argmin(means), means.shape)
    yield {
        "dataset": dataset.name,
        "method": plan.name,
        "augmentations": config.augmentations[column],
        "steps": int(step) + 1,
        "mean": means[step, column],
    }


def comparison(results: ExperimentResults, group: Group) -> Iterator[ReportTable | ReportFigure]:
    """The chosen models: cumulative errors, errors, and tests of differences."""
    rows: list[Row] = []
    tests: list[dict[str, object]] = []
    for dataset in results.datasets:
        tested = dataset.tested(group.plans, results.config)
        errors = {plan.name: dataset.errors(plan.name, results.config) for plan in tested}
        if tested:
            figure = new_figure(6.5, 4.2)
            plot_ced(errors, _CED_LIMIT, figure.subplots(), group.error)
            yield ReportFigure(f"ced-{dataset.name}-{group.stem}", f"{dataset.name}: cumulative errors", figure)
        rows += [_summary(dataset, plan, errors[plan.name]) for plan in tested]
        for one, other in combinations(tested, 2):
            compared = {"dataset": dataset.name, "methods": f"{one.name}, {other.name}"}
            tests.append(compared | difference_row(errors[other.name], errors[one.name], dataset.subjects))
    if rows:
        note = (
            "± 95 %: half the interval of the mean. From, to: 95 % bootstrap intervals. Both are by subject. Means are "
            "over fitted faces; those without a fit count in the rest."
        )
        yield ReportTable(f"errors-{group.stem}", f"Errors ({group.name})", _ERRORS, tuple(rows), note)
    if tests:
        add_holm(tests)
        note = (
            "The second method compared with the first. The rank-sum test assumes that all errors are independent; the "
            "signed-rank test uses that both methods were tested on the same faces, and takes several pictures of a "
            "person together. Holm's values are adjusted for all tests of the table."
        )
        columns = {"dataset": "", "methods": "", **DIFFERENCES}
        title = f"Differences between methods ({group.name})"
        yield ReportTable(f"tests-{group.stem}", title, columns, tuple(tests), note)


def difference_row(errors: np.ndarray, baseline: np.ndarray, subjects: np.ndarray) -> dict[str, object]:
    """The row of ``DIFFERENCES``, without Holm's p-value, for errors (N,) of two methods."""
    difference, width = relative_difference(errors, baseline, subjects)
    row = comparison_row(errors, baseline, subjects)
    compared = {key: row[key] for key in DIFFERENCES if key in COMPARISON_COLUMNS}
    return {"difference of means": difference, "± 95 %": width, **compared}


def add_holm(tests: Sequence[dict[str, object]]) -> None:
    """Put Holm's p-values of all signed-rank tests of a table into its rows."""
    adjusted = holm(np.array([row["signed-rank p"] for row in tests], float))
    for row, p in zip(tests, adjusted, strict=True):
        row["signed-rank p (Holm)"] = float(p)


def _summary(dataset: DatasetResults, plan: MethodPlan, errors: np.ndarray) -> Row:
    learned = dataset.learned[plan.name]
    row = summary_row(errors, dataset.subjects, None if np.isnan(learned).any() else learned)
    auc, failure = (interval(errors, subjects=dataset.subjects) for interval in (auc_ci, failure_ci))
    return {
        "dataset": dataset.name,
        "method": plan.name,
        **row,
        "AUC from": auc[0],
        "AUC to": auc[1],
        "failure from": failure[0],
        "failure to": failure[1],
    }


def times(results: ExperimentResults) -> Iterator[ReportTable]:
    """Milliseconds a face."""
    rows = []
    for dataset in results.datasets:
        for plan in results.config.methods:
            seconds = dataset.seconds[plan.name]
            if not len(seconds):
                continue
            low, median, high = (1000 * float(value) for value in np.percentile(seconds, [25, 50, 75]))
            rows.append(
                {
                    "dataset": dataset.name,
                    "method": plan.name,
                    "median ms": median,
                    "25 % ms": low,
                    "75 % ms": high,
                    "repetitions": len(seconds),
                    "faces": int(dataset.timed["faces"]),
                    "cores": int(dataset.timed["cores"]),
                }
            )
    if rows:
        columns = {
            heading: "" if heading in ("dataset", "method") else "d" if isinstance(value, int) else ".2f"
            for heading, value in rows[0].items()
        }
        note = (
            "Milliseconds a face: cropping and fitting, from pictures in memory, compiled; methods take turns. Other "
            "work on the machine at that time makes them longer."
        )
        yield ReportTable("times", "Time of a face", columns, tuple(rows), note)


def grid_tables(results: ExperimentResults) -> Iterator[ReportTable]:
    """Mean errors by steps and augmentations."""
    config = results.config
    for dataset in results.datasets:
        for plan in config.methods:
            means, widths = mean_and_ci(dataset.grid[plan.name], dataset.subjects)
            if np.isnan(means).all():
                continue
            columns, rows = {"steps": "d"}, []
            for count in config.augmentations:
                columns |= {f"{count}": ".4f", f"{count} ±": ".4f"}
            for step in range(1, config.steps + 1):
                row: dict[str, object] = {"steps": step}
                for column, count in enumerate(config.augmentations):
                    row |= {f"{count}": means[step - 1, column], f"{count} ±": widths[step - 1, column]}
                rows.append(row)
            yield ReportTable(f"grid-{dataset.name}-{plan.name}", f"{dataset.name}, {plan.name}", columns, tuple(rows))


def starts_tables(results: ExperimentResults) -> Iterator[ReportTable]:
    """Mean errors by initialisations."""
    config = results.config
    for dataset in results.datasets:
        columns: dict[str, str] = {"initialisations": "d"}
        rows: list[dict[str, object]] = [{"initialisations": count} for count in config.initialisations]
        for plan in config.methods:
            means, widths = mean_and_ci(dataset.starts[plan.name], dataset.subjects)
            if np.isnan(means).all():
                continue
            columns |= {plan.name: ".4f", f"{plan.name} ±": ".4f"}
            for row, mean, width in zip(rows, means, widths, strict=True):
                row |= {plan.name: mean, f"{plan.name} ±": width}
        if len(columns) > 1:
            yield ReportTable(f"starts-{dataset.name}", dataset.name, columns, tuple(rows))
