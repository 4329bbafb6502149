"""What a report says of errors of landmarks: parameters, comparisons, times, and the appendices A to C."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.plots import new_figure, plot_ced
from jaxfit.evaluation.statistics import auc_ci, failure_ci, holm, relative_difference
from jaxfit.evaluation.tables import COMPARISON_COLUMNS, Row, comparison_row, summary_row
from jaxfit.experiments.config import Config, MethodPlan
from jaxfit.experiments.document import Figure, Table
from jaxfit.experiments.figures import mean_and_ci, plot_grid, plot_starts
from jaxfit.experiments.results import DatasetResults, Results
from jaxfit.experiments.thesis import THESIS, numbered, of_thesis

_CED_LIMIT = 0.25  # where curves end, as in the thesis
_ERRORS = {
    "dataset": "",
    "method": "",
    "faces": "d",
    "no fit": "d",
    "unmeasured": "d",
    "mean": ".4f",
    "± 95 %": ".4f",
    "thesis": ".4f",
    "ratio to the thesis": ".2f",
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
    "thesis's rank-sum p": ".2g",
    "signed-rank p": ".2g",
    "signed-rank p (Holm)": ".2g",
}


class Group(NamedTuple):
    """Methods that are compared with one another: those whose errors are in 2D, or in 3D."""

    in_3d: bool
    name: str
    table: str
    plans: tuple[MethodPlan, ...]

    @property
    def error(self) -> str:
        """What is measured."""
        return f"NMED ({self.name})"

    @property
    def stem(self) -> str:
        """Of names of files."""
        return self.name.lower()


def parameters(results: Results, group: Group) -> Iterator[Table | Figure]:
    """Errors over steps, augmentations and initialisations (Figures 12 to 17), and the best of the grid."""
    config, rows = results.config, []
    for dataset in results.datasets:
        tested = dataset.tested(group.plans, config)
        if not tested:
            continue
        rows += [row for plan in tested for row in _best(dataset, config, plan)]
        grids = {plan.name: dataset.grid[plan.name] for plan in tested}
        yield Figure(
            f"grid-{dataset.name}-{group.stem}",
            numbered("grid", dataset.thesis, group.in_3d, f"{dataset.name}: errors over steps and augmentations"),
            plot_grid(grids, config.augmentations, group.error, dataset.subjects),
        )
        starts = {plan.name: dataset.starts[plan.name] for plan in tested}
        if len(config.initialisations) > 1 and all(np.isfinite(each).any(1).all() for each in starts.values()):
            known = ((plan.name, of_thesis("starts", dataset.thesis, plan.method)) for plan in tested)
            thesis = {name: of["mean"] for name, of in known if of}
            yield Figure(
                f"starts-{dataset.name}-{group.stem}",
                numbered("starts", dataset.thesis, group.in_3d, f"{dataset.name}: errors over initialisations"),
                plot_starts(
                    starts,
                    config.initialisations,
                    thesis,
                    THESIS["initialisations"],
                    group.error,
                    dataset.subjects,
                ),
                "Starts turned evenly over -90° to 90°, of models that were trained for one upright start, as in the "
                "thesis.",
            )
    if rows:
        columns = {
            "dataset": "",
            "method": "",
            "augmentations": "d",
            "steps": "d",
            "mean": ".4f",
            "thesis's augmentations": "d",
            "thesis's steps": "d",
        }
        note = (
            "The smallest mean error of the grid, over the faces that all its models fitted, on the faces that are "
            f"tested: what is compared below is not this but {config.chosen_augmentations} augmentations and "
            f"{config.chosen_steps} steps, chosen beforehand."
        )
        yield Table(f"best-{group.stem}", f"Best of the grid ({group.name})", columns, tuple(rows), note)


def _best(dataset: DatasetResults, config: Config, plan: MethodPlan) -> Iterator[Row]:
    """The row of a method, if any face was fitted by all its models."""
    grid = dataset.grid[plan.name]
    run = ~np.isnan(grid).all(2)
    fitted = np.isfinite(grid[run]).all(0)
    if not fitted.any():
        return
    means = np.where(run, grid[..., fitted].mean(2), np.inf)
    step, column = np.unravel_index(np.argmin(means), means.shape)
    augmentations, steps = of_thesis("selected", dataset.thesis, plan.method) or (None, None)
    yield {
        "dataset": dataset.name,
        "method": plan.name,
        "augmentations": config.augmentations[column],
        "steps": int(step) + 1,
        "mean": means[step, column],
        "thesis's augmentations": augmentations,
        "thesis's steps": steps,
    }


def comparison(results: Results, group: Group) -> Iterator[Table | Figure]:
    """The chosen models: cumulative errors (Figures 18 and 19), errors (Tables 3 and 5), and tests of differences."""
    rows: list[Row] = []
    tests: list[dict[str, object]] = []
    for dataset in results.datasets:
        tested = dataset.tested(group.plans, results.config)
        errors = {plan.name: dataset.errors(plan.name, results.config) for plan in tested}
        if tested:
            figure = new_figure(6.5, 4.2)
            plot_ced(errors, _CED_LIMIT, figure.subplots(), group.error)
            title = numbered("ced", dataset.thesis, group.in_3d, f"{dataset.name}: cumulative errors")
            yield Figure(f"ced-{dataset.name}-{group.stem}", title, figure)
        rows += [_summary(dataset, plan, errors[plan.name]) for plan in tested]
        for one, other in combinations(tested, 2):
            told = {"dataset": dataset.name, "methods": f"{one.name}, {other.name}"}
            difference = difference_row(errors[other.name], errors[one.name], dataset.subjects)
            tests.append({**told, **difference, "thesis's rank-sum p": _thesis_p(dataset, group, one, other)})
    if rows:
        note = (
            "± 95 %: half the interval of the mean. From, to: 95 % bootstrap intervals. Both are by subject. Means are "
            "over fitted faces; those without a fit count in the rest."
        )
        yield Table(f"errors-{group.stem}", f"{group.table}. Errors ({group.name})", _ERRORS, tuple(rows), note)
    if tests:
        add_holm(tests)
        note = (
            "Of the second method from the first. The rank-sum test is the thesis's; the signed-rank test uses that "
            "both methods were tested on the same faces, and takes several pictures of a person together. Holm's "
            "values are adjusted for all tests of the table."
        )
        columns = {"dataset": "", "methods": "", **DIFFERENCES}
        title = f"Differences between methods ({group.name})"
        yield Table(f"tests-{group.stem}", title, columns, tuple(tests), note)


def difference_row(errors: np.ndarray, baseline: np.ndarray, subjects: np.ndarray) -> dict[str, object]:
    """The row of ``DIFFERENCES``, but for Holm's and the thesis's p-values, for errors (N,) of two methods."""
    difference, width = relative_difference(errors, baseline, subjects)
    row = comparison_row(errors, baseline, subjects)
    told = {key: row[key] for key in DIFFERENCES if key in COMPARISON_COLUMNS}
    return {"difference of means": difference, "± 95 %": width, **told}


def add_holm(tests: Sequence[dict[str, object]]) -> None:
    """Put Holm's p-values of all signed-rank tests of a table into its rows."""
    adjusted = holm(np.array([row["signed-rank p"] for row in tests], float))
    for row, p in zip(tests, adjusted, strict=True):
        row["signed-rank p (Holm)"] = float(p)


def _summary(dataset: DatasetResults, plan: MethodPlan, errors: np.ndarray) -> Row:
    row = summary_row(errors, dataset.subjects)
    mean, _ = of_thesis("errors", dataset.thesis, plan.method) or (np.nan, np.nan)
    auc, failure = (interval(errors, subjects=dataset.subjects) for interval in (auc_ci, failure_ci))
    return {
        "dataset": dataset.name,
        "method": plan.name,
        **row,
        "thesis": mean,
        "ratio to the thesis": float(row["mean"]) / mean,  # type: ignore[arg-type]
        "AUC from": auc[0],
        "AUC to": auc[1],
        "failure from": failure[0],
        "failure to": failure[1],
    }


def _thesis_p(dataset: DatasetResults, group: Group, one: MethodPlan, other: MethodPlan) -> float:
    compared = {"alignment3d", "regression3d"} if group.in_3d else {"sdm", "parametric"}
    known = THESIS["p"].get(dataset.thesis or "")
    return float(known[group.stem]) if known and {one.method, other.method} == compared else np.nan


def times(results: Results) -> Iterator[Table]:
    """Milliseconds a face (Tables 4 and 6)."""
    rows = []
    for dataset in results.datasets:
        for plan in results.config.methods:
            seconds = dataset.seconds[plan.name]
            if not len(seconds):
                continue
            low, median, high = (1000 * float(value) for value in np.percentile(seconds, [25, 50, 75]))
            thesis = 1000 * float(of_thesis("seconds", dataset.thesis, plan.method) or np.nan)
            rows.append(
                {
                    "dataset": dataset.name,
                    "method": plan.name,
                    "median ms": median,
                    "25 % ms": low,
                    "75 % ms": high,
                    "thesis ms": thesis,
                    "ratio to the thesis": median / thesis,
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
        yield Table("times", "Tables 4, 6. Time of a face", columns, tuple(rows), note)


def grid_tables(results: Results) -> Iterator[Table]:
    """Mean errors by steps and augmentations (Appendices A and B)."""
    config = results.config
    for dataset in results.datasets:
        for plan in config.methods:
            means, widths = mean_and_ci(dataset.grid[plan.name], dataset.subjects)
            if np.isnan(means).all():
                continue
            known = of_thesis("grid", dataset.thesis, plan.method)
            columns, rows = {"steps": "d"}, []
            for count in config.augmentations:
                columns |= {f"{count}": ".4f", f"{count} ±": ".4f"} | ({f"{count} ratio": ".2f"} if known else {})
            for step in range(1, config.steps + 1):
                row: dict[str, object] = {"steps": step}
                for column, count in enumerate(config.augmentations):
                    has = known and step <= len(known["mean"]) and count in THESIS["augmentations"]
                    thesis = known["mean"][step - 1][THESIS["augmentations"].index(count)] if has else np.nan
                    mean, width = means[step - 1, column], widths[step - 1, column]
                    row |= {f"{count}": mean, f"{count} ±": width, f"{count} ratio": mean / thesis}
                rows.append(row)
            yield Table(f"grid-{dataset.name}-{plan.name}", f"{dataset.name}, {plan.name}", columns, tuple(rows))


def starts_tables(results: Results) -> Iterator[Table]:
    """Mean errors by initialisations (Appendix C)."""
    config = results.config
    for dataset in results.datasets:
        columns: dict[str, str] = {"initialisations": "d"}
        rows: list[dict[str, object]] = [{"initialisations": count} for count in config.initialisations]
        for plan in config.methods:
            means, widths = mean_and_ci(dataset.starts[plan.name], dataset.subjects)
            if np.isnan(means).all():
                continue
            known = of_thesis("starts", dataset.thesis, plan.method)
            columns |= {plan.name: ".4f", f"{plan.name} ±": ".4f"} | ({f"{plan.name} ratio": ".2f"} if known else {})
            for row, count, mean, width in zip(rows, config.initialisations, means, widths, strict=True):
                has = known and count in THESIS["initialisations"]
                thesis = known["mean"][THESIS["initialisations"].index(count)] if has else np.nan
                row |= {plan.name: mean, f"{plan.name} ±": width, f"{plan.name} ratio": mean / thesis}
        if len(columns) > 1:
            yield Table(f"starts-{dataset.name}", dataset.name, columns, tuple(rows))
