"""The report of an experiment: the thesis's tables and figures from what was run, with the thesis's numbers beside."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.errors import NORMALISER_TITLES
from jaxfit.evaluation.plots import new_figure, plot_ced, plot_pose_surface
from jaxfit.evaluation.pose import ANGLES, POSE_COLUMNS, PoseGrid, compare_pose, pose_errors, pose_grid, pose_rows
from jaxfit.evaluation.statistics import auc_ci, both_measured, failure_ci, holm, rank_sum, signed_rank, summarise
from jaxfit.evaluation.tables import Row
from jaxfit.experiments.claims import claims
from jaxfit.experiments.config import Config, MethodPlan
from jaxfit.experiments.document import Document, Figure, Section, Table
from jaxfit.experiments.faces import Thumbnails, gallery, spread_by_rank
from jaxfit.experiments.figures import mean_and_ci, plot_fits, plot_grid, plot_starts
from jaxfit.experiments.page import write_document
from jaxfit.experiments.results import DatasetResults, PoseResults, Results, read_results
from jaxfit.experiments.thesis import THESIS

_GALLERY = 150  # faces of each dataset
_SHOWN = 6  # faces of each dataset in a figure
_CED_LIMIT = 0.25  # where curves end, as in the thesis
# Where true poses are not a few discrete ones.
_PITCHES, _YAWS = np.arange(-60, 61, 30.0), np.arange(-90, 91, 22.5)
_MOST_POSES = 20
# The thesis's numbers of figures and tables, for 2D and 3D methods.
_NUMBERS = {
    ("grid", "AFLW"): ("Figure 12", "Figure 15"),
    ("grid", "LFPW"): ("Figure 13", "Figure 16"),
    ("starts", "AFLW"): ("Figure 14a", "Figure 17a"),
    ("starts", "LFPW"): ("Figure 14b", "Figure 17b"),
    ("ced", "AFLW"): ("Figure 18a", "Figure 19a"),
    ("ced", "LFPW"): ("Figure 18b", "Figure 19b"),
    ("fits", "AFLW"): ("Figure 22a", "Figure 23a"),
    ("fits", "LFPW"): ("Figure 22b", "Figure 23b"),
}
_KINDS = ("2d", "3d")
Thesis = dict[str, float]


def write_report(folder: Path, target: Path, pictures: bool = True) -> int:
    """Write the report of the experiment in a folder, as far as it has been run.

    Args:
        folder: of the experiment.
        target: the folder to write ``report.html``, tables and figures into.
        pictures: show pictures of faces; without, their landmarks alone.

    Returns:
        How many cells are not run yet.

    Raises:
        InputError: a result is damaged, or matplotlib or jinja2 is missing.
    """
    results = read_results(folder)
    write_document(document(results, pictures), target)
    return results.missing


def document(results: Results, pictures: bool = True) -> Document:
    """The report of an experiment; what was not run is left out."""
    config = results.config
    flat = _Group("2d", "2D methods (5.2)", "Table 3", tuple(plan for plan in config.methods if not plan.in_3d))
    solid = _Group("3d", "3D methods (5.3)", "Table 5", tuple(plan for plan in config.methods if plan.in_3d))
    groups = [group for group in (flat, solid) if group.plans]
    about = {
        "run": f"{results.cells - results.missing} of {results.cells} cells, {results.hours:.1f} hours of one process",
        "faces": ", ".join(f"{dataset.name} {len(dataset.faces['face'])}" for dataset in results.datasets),
        "cross-validation": f"{config.folds} folds, split by subject, seed {config.seed}",
        "compared": f"models of {config.chosen_augmentations} augmentations and {config.chosen_steps} steps",
        "errors": f"normalised mean Euclidean distance (Eq. 16), over {NORMALISER_TITLES[config.normaliser]}; "
        "of 3D methods in 3D",
        "run with": "; ".join(results.made_with),
    }
    sections = [
        _claims(results),
        Section(
            "Parameters (5.1)",
            (
                "Errors over the numbers of cascade steps, augmentations and initialisations. One training of all "
                "steps gives the errors after each of them.",
            ),
            tuple(part for group in groups for part in _parameters(results, group)),
        ),
        *(Section(group.title, (), tuple(_comparison(results, group))) for group in groups),
        Section("Times (Tables 4 and 6)", (), tuple(_times(results))),
        Section("Pose (5.4)", (), tuple(part for pose in results.pose for part in _pose(pose))),
        Section(
            "Fitted faces (5.5)",
            ("Labels in red, fits in cyan: the best, those between, and the worst.",),
            (
                *(
                    part
                    for dataset in results.datasets
                    for group in groups
                    for part in _fits(dataset, config, group, pictures)
                ),
                *([gallery(results.datasets, config, _GALLERY, pictures)] if results.datasets else []),
            ),
        ),
        Section(
            "Appendices A, B: the grid",
            ("Mean errors after each number of steps (rows), by augmentations; ratios are to the thesis's.",),
            tuple(
                table
                for dataset in results.datasets
                for plan in config.methods
                for table in _grid(dataset, config, plan)
            ),
        ),
        Section(
            "Appendix C: initialisations", (), tuple(_starts_table(dataset, config) for dataset in results.datasets)
        ),
        Section(
            "Appendices D, E: pose by true pose",
            (
                "Mean absolute errors in degrees by true pitch (rows) and yaw. Pitches are Pointing'04's tilts; the "
                "appendices of the thesis print them multiplied by 0.75.",
            ),
            tuple(table for pose in results.pose for table in _pose_tables(pose)),
        ),
    ]
    sections = [section for section in sections if section.parts]
    if results.problems:
        sections.append(Section("Problems", results.problems))
    return Document("Experiments", about, tuple(sections))


class _Group(NamedTuple):
    """Methods that are compared with one another, and where."""

    kind: str
    title: str
    table: str
    plans: tuple[MethodPlan, ...]


def _run(dataset: DatasetResults, config: Config, plans: Sequence[MethodPlan]) -> list[MethodPlan]:
    """Those methods whose chosen models were tested."""
    return [plan for plan in plans if not np.isnan(dataset.errors(plan.name, config)).all()]


def _title(what: str, dataset: DatasetResults, kind: str, title: str) -> str:
    number = _NUMBERS.get((what, dataset.thesis or ""))
    return f"{number[_KINDS.index(kind)]}. {title}" if number else title


def _of_thesis(dataset: DatasetResults, part: str, plan: MethodPlan) -> Any:
    """What a part of the thesis's numbers says of a method on the dataset's counterpart; None if nothing."""
    return THESIS[part].get(dataset.thesis or "", {}).get(plan.method)


def _claims(results: Results) -> Section:
    rows = [
        {
            "": claim.letter,
            "claim": claim.claim,
            "on": claim.where,
            "here": "holds" if claim.holds else "does not hold",
            "found": claim.found,
            "test": claim.test,
            "p": claim.p,
            "p (Holm)": adjusted,
        }
        for claim, adjusted in claims(results)
    ]
    columns = {"": "", "claim": "", "on": "", "here": "", "found": "", "test": "", "p": ".1e", "p (Holm)": ".1e"}
    note = "Holm's p-values are adjusted for all tests of this table."
    return Section("The thesis's claims", (), (Table("claims", "Claims", columns, tuple(rows), note),) if rows else ())


def _parameters(results: Results, group: _Group) -> Iterator[Table | Figure]:
    config, kind, plans = results.config, group.kind, group.plans
    for dataset in results.datasets:
        run = _run(dataset, config, plans)
        if not run:
            continue
        grids = {plan.name: dataset.grid[plan.name] for plan in run}
        title = _title("grid", dataset, kind, f"{dataset.name}: errors over steps and augmentations")
        yield Figure(
            f"grid-{dataset.name}-{kind}", title, plot_grid(grids, config.augmentations, f"NMED ({kind.upper()})")
        )
        starts = {plan.name: dataset.starts[plan.name] for plan in run}
        if len(config.initialisations) > 1 and all(np.isfinite(each).any(1).all() for each in starts.values()):
            thesis = {plan.name: of["mean"] for plan in run if (of := _of_thesis(dataset, "starts", plan))}
            title = _title("starts", dataset, kind, f"{dataset.name}: errors over initialisations")
            figure = plot_starts(starts, config.initialisations, thesis, THESIS["initialisations"])
            note = (
                "Starts turned evenly over -90° to 90°, of models that were trained for one upright start, as in the "
                "thesis."
            )
            yield Figure(f"starts-{dataset.name}-{kind}", title, figure, note)
    rows = [row for dataset in results.datasets for row in _best(dataset, config, _run(dataset, config, plans))]
    columns = {
        "dataset": "",
        "method": "",
        "augmentations": "d",
        "steps": "d",
        "mean": ".4f",
        "thesis's augmentations": "d",
        "thesis's steps": "d",
    }
    if rows:
        note = (
            "The smallest mean error of the grid, on the faces that are tested: what is compared below is not "
            f"this but {config.chosen_augmentations} augmentations and {config.chosen_steps} steps, chosen beforehand."
        )
        yield Table(f"best-{kind}", f"Best of the grid ({kind.upper()})", columns, tuple(rows), note)


def _best(dataset: DatasetResults, config: Config, plans: Sequence[MethodPlan]) -> Iterator[Row]:
    for plan in plans:
        means = mean_and_ci(dataset.grid[plan.name])[0]
        step, column = np.unravel_index(np.nanargmin(means), means.shape)
        row: dict[str, object] = {
            "dataset": dataset.name,
            "method": plan.name,
            "augmentations": config.augmentations[column],
            "steps": int(step) + 1,
            "mean": means[step, column],
        }
        selected = _of_thesis(dataset, "selected", plan)
        if isinstance(selected, list):
            row |= {"thesis's augmentations": selected[0], "thesis's steps": selected[1]}
        yield row


def _comparison(results: Results, group: _Group) -> Iterator[Table | Figure]:
    config, kind, rows, tests = results.config, group.kind, [], []
    for dataset in results.datasets:
        run = _run(dataset, config, group.plans)
        errors = {plan.name: dataset.errors(plan.name, config) for plan in run}
        rows += [_summary(dataset, plan, errors[plan.name]) for plan in run]
        for one, other in combinations(run, 2):
            pair = both_measured(errors[one.name], errors[other.name])
            tests.append(
                {
                    "dataset": dataset.name,
                    "methods": f"{one.name}, {other.name}",
                    "difference of medians": summarise(pair[1]).median / summarise(pair[0]).median - 1,
                    "rank-sum p": rank_sum(*pair),
                    "signed-rank p": signed_rank(*pair),
                    "thesis's rank-sum p": _thesis_p(dataset, kind, one, other),
                }
            )
        if run:
            figure = new_figure(6.5, 4.2)
            plot_ced(errors, _CED_LIMIT, figure.subplots())
            yield Figure(
                f"ced-{dataset.name}-{kind}", _title("ced", dataset, kind, f"{dataset.name}: cumulative errors"), figure
            )
    columns = {
        "dataset": "",
        "method": "",
        "faces": "d",
        "no fit": "d",
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
    note = (
        "From, to: 95 % bootstrap intervals, resampled by subject. Means are over fitted faces; those without a fit "
        "count in the rest."
    )
    if rows:
        yield Table(f"errors-{kind}", f"{group.table}. Errors ({kind.upper()})", columns, tuple(rows), note)
    if tests:
        for name in ("rank-sum p", "signed-rank p"):
            adjusted = holm(np.array([row[name] for row in tests]))
            for row, p in zip(tests, adjusted, strict=True):
                row[f"{name} (Holm)"] = float(p)
        columns = {
            "dataset": "",
            "methods": "",
            "difference of medians": "+.1%",
            "rank-sum p": ".1e",
            "rank-sum p (Holm)": ".1e",
            "thesis's rank-sum p": ".1e",
            "signed-rank p": ".1e",
            "signed-rank p (Holm)": ".1e",
        }
        note = (
            "Of the second method from the first. The rank-sum test is the thesis's; the signed-rank test uses that "
            "both methods were tested on the same faces. Holm's values are adjusted for all tests of a column."
        )
        yield Table(f"tests-{kind}", f"Differences between methods ({kind.upper()})", columns, tuple(tests), note)


def _summary(dataset: DatasetResults, plan: MethodPlan, errors: np.ndarray) -> Row:
    summary, subjects = summarise(errors), list(map(str, dataset.faces["subject"]))
    thesis = _of_thesis(dataset, "errors", plan)
    mean = thesis[0] if isinstance(thesis, list) else np.nan
    auc, failure = auc_ci(errors, subjects=subjects), failure_ci(errors, subjects=subjects)
    return {
        "dataset": dataset.name,
        "method": plan.name,
        "faces": summary.measured + summary.failed,
        "no fit": summary.failed,
        "mean": summary.mean,
        "± 95 %": summary.ci95,
        "thesis": mean,
        "ratio to the thesis": summary.mean / mean,
        "median": summary.median,
        f"AUC@{LIMIT:g}": summary.auc,
        "AUC from": auc[0],
        "AUC to": auc[1],
        f"failure@{LIMIT:g}": summary.failure,
        "failure from": failure[0],
        "failure to": failure[1],
    }


def _thesis_p(dataset: DatasetResults, kind: str, one: MethodPlan, other: MethodPlan) -> float:
    compared = {"2d": {"sdm", "parametric"}, "3d": {"alignment3d", "regression3d"}}[kind]
    known = THESIS["p"].get(dataset.thesis or "")
    return float(known[kind]) if known and {one.method, other.method} == compared else np.nan


def _times(results: Results) -> Iterator[Table]:
    rows = []
    for dataset in results.datasets:
        for plan in results.config.methods:
            seconds = dataset.seconds[plan.name]
            if not len(seconds):
                continue
            low, median, high = (1000 * float(value) for value in np.percentile(seconds, [25, 50, 75]))
            known = _of_thesis(dataset, "seconds", plan)
            thesis = 1000 * known if isinstance(known, float) else np.nan
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
                    "load before": dataset.timed["load"],
                }
            )
    columns = {
        "dataset": "",
        "method": "",
        **dict.fromkeys(("median ms", "25 % ms", "75 % ms", "thesis ms"), ".2f"),
        "ratio to the thesis": ".2f",
        **dict.fromkeys(("repetitions", "faces", "cores"), "d"),
        "load before": ".1f",
    }
    note = (
        "Milliseconds a face: cropping and fitting, from pictures in memory, compiled; methods take turns. A load "
        "before near the number of cores tells that other work ran at the same time."
    )
    if rows:
        yield Table("times", "Tables 4, 6. Time of a face", columns, tuple(rows), note)


def _pose(pose: PoseResults) -> Iterator[Table | Figure]:
    rows = []
    for name, fitted in pose.fitted.items():
        for row in pose_rows(fitted, pose.truth):
            known = (
                THESIS["pose"].get(name, {}).get(row["angle"]) if _like_thesis(pose) and row["range"] == "all" else None
            )
            mean = known[0] if known else np.nan
            rows.append({"method": name, **row, "thesis": mean, "ratio to the thesis": row["MAE"] / mean})  # type: ignore[operator]
    columns = {"method": "", **POSE_COLUMNS, "thesis": ".2f", "ratio to the thesis": ".2f"}
    title = f"{'Table 7. ' if _like_thesis(pose) else ''}{pose.name}: errors of pose, degrees"
    yield Table(f"pose-{pose.name}", title, columns, tuple(rows))
    errors = {name: pose_errors(fitted, pose.truth) for name, fitted in pose.fitted.items()}
    tests = []
    for one, other in combinations(errors, 2):
        for angle, p in compare_pose(errors[one], errors[other]).items():
            thesis = THESIS["pose_p"].get(angle, np.nan) if _like_thesis(pose) else np.nan
            tests.append({"methods": f"{one}, {other}", "angle": angle, "rank-sum p": p, "thesis's p": thesis})
    tests = [row for row in tests if not np.isnan(row["rank-sum p"])]
    if tests:
        columns = {"methods": "", "angle": "", "rank-sum p": ".1e", "thesis's p": ".1e"}
        yield Table(f"pose-tests-{pose.name}", f"{pose.name}: differences between methods", columns, tuple(tests))
    numbers = {"alignment3d": "Figure 20. ", "regression3d": "Figure 21. "} if _like_thesis(pose) else {}
    for name in pose.fitted:
        figure = new_figure(11.0, 4.5)
        for column, angle in enumerate(("pitch", "yaw"), 1):
            plot_pose_surface(
                _by_pose(pose, name, angle), figure.add_subplot(1, 2, column, projection="3d"), f"{angle} error"
            )
        yield Figure(
            f"surface-{pose.name}-{name}", f"{numbers.get(name, '')}{pose.name}, {name}: errors by true pose", figure
        )


def _like_thesis(pose: PoseResults) -> bool:
    return pose.name.startswith("pointing04")


def _by_pose(pose: PoseResults, method: str, angle: str) -> PoseGrid:
    errors = pose_errors(pose.fitted[method], pose.truth)[:, ANGLES.index(angle)]
    discrete = all(len(np.unique(pose.truth[:, ANGLES.index(of)])) <= _MOST_POSES for of in ("pitch", "yaw"))
    return pose_grid(errors, pose.truth, *((None, None) if discrete else (_PITCHES, _YAWS)))


def _pose_tables(pose: PoseResults) -> Iterator[Table]:
    for name in pose.fitted:
        for angle in ("pitch", "yaw"):
            grid = _by_pose(pose, name, angle)
            headings = [f"{yaw:g}" for yaw in grid.yaws]
            rows = [
                {"pitch \\ yaw": float(pitch), **dict(zip(headings, map(float, means), strict=True))}
                for pitch, means in zip(grid.pitches, grid.mean, strict=True)
            ]
            columns = {"pitch \\ yaw": "g", **dict.fromkeys(headings, ".1f")}
            note = ""
            thesis = _thesis_pose(pose, name, angle, grid)
            if thesis is not None:
                ratio = float(np.nanmean(grid.mean[~np.isnan(thesis)]) / np.nanmean(thesis))
                note = f"Mean over these cells: {ratio:.2f} times the thesis's."
                for row, values in zip(rows, thesis, strict=True):
                    row |= {f"{heading} (thesis)": float(v) for heading, v in zip(headings, values, strict=True)}
                columns |= {f"{heading} (thesis)": ".1f" for heading in headings}
            yield Table(
                f"pose-{pose.name}-{name}-{angle}", f"{pose.name}, {name}: {angle} errors", columns, tuple(rows), note
            )


def _thesis_pose(pose: PoseResults, method: str, angle: str, grid: PoseGrid) -> np.ndarray | None:
    """The thesis's table, if its poses are those of the grid."""
    same = list(grid.pitches) == THESIS["pitches"] and list(grid.yaws) == THESIS["yaws"]
    if not (same and _like_thesis(pose) and method in THESIS["pose_grid"]):
        return None
    return np.array(THESIS["pose_grid"][method][angle], float)


def _fits(dataset: DatasetResults, config: Config, group: _Group, pictures: bool) -> Iterator[Figure]:
    kind, run = group.kind, _run(dataset, config, group.plans)
    if not run:
        return
    errors = dataset.errors(run[0].name, config)
    numbers = spread_by_rank(errors, _SHOWN)
    thumbnails = Thumbnails(dataset, pictures)
    titles = [f"{errors[number]:.3f}" for number in numbers]
    titles[0], titles[-1] = f"best: {titles[0]}", f"worst: {titles[-1]}"
    truths = [thumbnails.points(number, dataset.faces["landmarks"][number]) for number in numbers]
    fits = {
        plan.name: [thumbnails.points(number, dataset.fits[plan.name][number]) for number in numbers] for plan in run
    }
    figure = plot_fits([thumbnails.picture(number) for number in numbers], truths, fits, titles, dataset.scheme)
    title = _title("fits", dataset, kind, f"{dataset.name}: from the best to the worst fit of {run[0].name}")
    yield Figure(f"fits-{dataset.name}-{kind}", title, figure)


def _grid(dataset: DatasetResults, config: Config, plan: MethodPlan) -> Iterator[Table]:
    means, widths = mean_and_ci(dataset.grid[plan.name])
    if np.isnan(means).all():
        return
    known = _of_thesis(dataset, "grid", plan)

    def thesis(step: int, count: int) -> float:
        if not isinstance(known, dict) or step > len(known["mean"]) or count not in THESIS["augmentations"]:
            return float("nan")
        return float(known["mean"][step - 1][THESIS["augmentations"].index(count)])

    rows, columns = [], {"steps": "d"}
    for count in config.augmentations:
        columns |= {f"{count}": ".4f", f"{count} ±": ".4f"} | ({f"{count} ratio": ".2f"} if known else {})
    for step in range(1, config.steps + 1):
        row: dict[str, object] = {"steps": step}
        for column, count in enumerate(config.augmentations):
            mean, width = means[step - 1, column], widths[step - 1, column]
            row |= {f"{count}": mean, f"{count} ±": width, f"{count} ratio": mean / thesis(step, count)}
        rows.append(row)
    yield Table(f"grid-{dataset.name}-{plan.name}", f"{dataset.name}, {plan.name}", columns, tuple(rows))


def _starts_table(dataset: DatasetResults, config: Config) -> Table:
    columns, rows = {"initialisations": "d"}, []
    for plan in config.methods:
        known = _of_thesis(dataset, "starts", plan)
        columns |= {plan.name: ".4f", f"{plan.name} ±": ".4f"} | ({f"{plan.name} ratio": ".2f"} if known else {})
    for number, count in enumerate(config.initialisations):
        row: dict[str, object] = {"initialisations": count}
        for plan in config.methods:
            mean, width = (float(each) for each in mean_and_ci(dataset.starts[plan.name][number]))
            known = _of_thesis(dataset, "starts", plan)
            has = isinstance(known, dict) and count in THESIS["initialisations"]
            thesis = known["mean"][THESIS["initialisations"].index(count)] if has else np.nan
            row |= {plan.name: mean, f"{plan.name} ±": width, f"{plan.name} ratio": mean / thesis}
        rows.append(row)
    return Table(f"starts-{dataset.name}", dataset.name, columns, tuple(rows))
