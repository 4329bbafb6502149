"""A report beside the thesis: its numbers next to those that were measured, its numbers of figures, and its claims.

Reports know nothing of the thesis. What is here is put into a finished one, part by part, and only where the
configuration names one of the thesis's datasets.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from jaxfit.evaluation.tables import Row
from jaxfit.experiments.config import Config
from jaxfit.experiments.report_parts import Part, Report, ReportFigure, ReportTable, Section
from jaxfit.experiments.report_pose import GRID_ANGLES, grid_by_pose
from jaxfit.experiments.results import DatasetResults, ExperimentResults, PoseResults
from jaxfit.experiments.thesis.claims import thesis_claims
from jaxfit.experiments.thesis.numbers import THESIS, thesis_value

# The kind and name of a part of a report, and what makes another of it.
_Change = tuple[tuple[type, str], Callable[[Any], Part]]
_Titled = TypeVar("_Titled", ReportTable, ReportFigure)

# By the section's name: its title, and what is added to its text.
_SECTIONS = {
    "parameters": ("Parameters (5.1)", ""),
    "methods-2d": ("2D methods (5.2)", ""),
    "methods-3d": ("3D methods (5.3)", ""),
    "times": ("Times (Tables 4 and 6)", ""),
    "pose": ("Pose (5.4)", ""),
    "faces": ("Fitted faces (5.5)", ""),
    "grid": ("Appendices A, B: the grid", "Ratios are to the thesis's."),
    "starts": ("Appendix C: initialisations", ""),
    "pose-grids": (
        "Appendices D, E: pose by true pose",
        "Pitches are Pointing'04's tilts; the appendices of the thesis print them multiplied by 0.75.",
    ),
}
# Figures of the thesis, by what they show and the dataset: for 2D and 3D methods.
_FIGURES = {
    ("grid", "AFLW"): ("Figure 12", "Figure 15"),
    ("grid", "LFPW"): ("Figure 13", "Figure 16"),
    ("starts", "AFLW"): ("Figure 14a", "Figure 17a"),
    ("starts", "LFPW"): ("Figure 14b", "Figure 17b"),
    ("ced", "AFLW"): ("Figure 18a", "Figure 19a"),
    ("ced", "LFPW"): ("Figure 18b", "Figure 19b"),
    ("fits", "AFLW"): ("Figure 22a", "Figure 23a"),
    ("fits", "LFPW"): ("Figure 22b", "Figure 23b"),
}
_POSE_FIGURES = {"alignment3d": "Figure 20", "regression3d": "Figure 21"}
_KINDS = ("2d", "3d")
# Methods that the thesis compares with one another.
_COMPARED = {"2d": {"sdm", "parametric"}, "3d": {"alignment3d", "regression3d"}}
_POSE_DATASET = "pointing04"


def with_thesis(report: Report, results: ExperimentResults) -> Report:
    """The report of an experiment with the thesis's numbers beside its own, and the claims of the thesis before them.

    Args:
        report: without them; its figures are drawn on.
        results: what the report is of.
    """
    changes = dict(_changes(results))

    def changed(part: Part) -> Part:
        change = changes.get((type(part), part.name))
        return part if change is None else change(part)

    sections = [_renamed(replace(section, parts=tuple(map(changed, section.parts)))) for section in report.sections]
    return replace(report, about=_about(report.about, results), sections=(*_claims(results), *sections))


def _renamed(section: Section) -> Section:
    title, addition = _SECTIONS.get(section.name, (section.title, ""))
    text = (f"{section.text[0]} {addition}", *section.text[1:]) if addition else section.text
    return replace(section, title=title, text=text)


def _about(about: Mapping[str, str], results: ExperimentResults) -> dict[str, str]:
    """The facts below the title, with those of the thesis after that on errors."""
    beside = "; ".join(_beside(dataset) for dataset in results.datasets if dataset.thesis)
    known = {"the thesis": THESIS["title"], "its numbers": beside}
    facts = dict(about) | {"errors": about["errors"].replace(" distance", " distance (Eq. 16)", 1)}
    return _inserted(facts, "errors", {term: fact for term, fact in known.items() if fact})


def _beside(dataset: DatasetResults) -> str:
    known = dataset.thesis or ""
    faces, points = THESIS["faces"][known], THESIS["points"][known]
    return f"beside {dataset.name} ({dataset.scheme.count} points) those of {known} ({points} points, {faces} faces)"


def _claims(results: ExperimentResults) -> Iterator[Section]:
    rows = tuple(
        {
            "": claim.letter,
            "claim": claim.claim,
            "on": claim.where,
            "here": claim.verdict,
            "found": claim.found,
            "test": claim.test,
            "p": claim.p,
            "p (Holm)": claim.adjusted,
        }
        for claim in thesis_claims(results)
    )
    columns = {"": "", "claim": "", "on": "", "here": "", "found": "", "test": "", "p": ".2g", "p (Holm)": ".2g"}
    note = (
        "A claim of a difference holds where the figures are as claimed and Holm's p-value, adjusted for all tests of "
        "the same letter, is below 0.05; one of equality where the 95 % interval of the relative difference of the "
        "means is narrow enough. Not shown: the figures are as claimed, but chance or the faces at hand may have made "
        "them so. Means are over the faces that all fitted. Several pictures of a person are taken together."
    )
    if rows:
        yield Section("The thesis's claims", (), (ReportTable("claims", "Claims", columns, rows, note),), name="claims")


def _changes(results: ExperimentResults) -> Iterator[_Change]:
    """What is changed, by kind and name."""
    config = results.config
    datasets = {dataset.name: dataset for dataset in results.datasets}
    yield (ReportTable, "times"), partial(_times, config, datasets)
    for in_3d, kind in enumerate(_KINDS):
        yield (ReportTable, f"best-{kind}"), partial(_best, config, datasets)
        yield (ReportTable, f"errors-{kind}"), partial(_errors, config, datasets, ("Table 3", "Table 5")[in_3d])
        yield (ReportTable, f"tests-{kind}"), partial(_tests, config, datasets, kind)
        for dataset in results.datasets:
            for what in ("grid", "ced", "fits"):
                if figures := _FIGURES.get((what, dataset.thesis or "")):
                    yield (ReportFigure, f"{what}-{dataset.name}-{kind}"), partial(_numbered, figures[in_3d])
            yield (ReportFigure, f"starts-{dataset.name}-{kind}"), partial(_starts_figure, config, dataset, in_3d)
    for dataset in results.datasets:
        yield (ReportTable, f"starts-{dataset.name}"), partial(_starts_table, config, dataset)
        for plan in config.methods:
            if known := thesis_value("grid", dataset.thesis, plan.method):
                yield (ReportTable, f"grid-{dataset.name}-{plan.name}"), partial(_grid, config, known["mean"])
    for pose in results.pose:
        if pose.name == _POSE_DATASET:
            yield from _pose_changes(pose, config)


def _numbered(number: str, part: _Titled) -> _Titled:
    """A part with the number of the thesis's table or figure of the same before its title."""
    return replace(part, title=f"{number}. {part.title}")


def _inserted(values: Mapping[str, Any], after: str, new: Mapping[str, Any]) -> dict[str, Any]:
    """The values with new ones after one of them."""
    pairs = [({key: value} | (dict(new) if key == after else {})) for key, value in values.items()]
    return {key: value for pair in pairs for key, value in pair.items()}


def _extended(
    table: ReportTable, after: str, columns: Mapping[str, str], values_of: Callable[[Any], Sequence[object]]
) -> ReportTable:
    """A table with more columns after one of its own.

    Args:
        table: what they are put into.
        after: a heading of it.
        columns: the new headings and formats.
        values_of: gives the values of these for a row.
    """
    rows = tuple({**row, **dict(zip(columns, values_of(row), strict=True))} for row in table.rows)
    return replace(table, columns=_inserted(table.columns, after, columns), rows=rows)


def _best(config: Config, datasets: Mapping[str, DatasetResults], table: ReportTable) -> ReportTable:
    def selected(row: Row) -> Sequence[object]:
        method = config.method(str(row["method"])).method
        return thesis_value("selected", datasets[str(row["dataset"])].thesis, method) or (None, None)

    return _extended(table, "mean", {"thesis's augmentations": "d", "thesis's steps": "d"}, selected)


def _errors(config: Config, datasets: Mapping[str, DatasetResults], number: str, table: ReportTable) -> ReportTable:
    """Tables 3 and 5."""

    def beside(row: Row) -> Sequence[object]:
        method = config.method(str(row["method"])).method
        mean, _ = thesis_value("errors", datasets[str(row["dataset"])].thesis, method) or (np.nan, np.nan)
        return mean, _number(row["mean"]) / mean

    columns = {"thesis": ".4f", "ratio to the thesis": ".2f"}
    return _numbered(number, _extended(table, "± 95 %", columns, beside))


def _tests(config: Config, datasets: Mapping[str, DatasetResults], kind: str, table: ReportTable) -> ReportTable:
    def p_value(row: Row) -> Sequence[object]:
        methods = {config.method(name).method for name in str(row["methods"]).split(", ")}
        known = THESIS["p"].get(datasets[str(row["dataset"])].thesis or "")
        return (float(known[kind]) if known and methods == _COMPARED[kind] else np.nan,)

    return _with_rank_sum(table, p_value)


def _with_rank_sum(table: ReportTable, p_value: Callable[[Row], Sequence[object]]) -> ReportTable:
    changed = _extended(table, "rank-sum p", {"thesis's rank-sum p": ".2g"}, p_value)
    return replace(changed, note=f"{table.note} The rank-sum test is the thesis's.")


def _times(config: Config, datasets: Mapping[str, DatasetResults], table: ReportTable) -> ReportTable:
    """Tables 4 and 6."""

    def beside(row: Row) -> Sequence[object]:
        method = config.method(str(row["method"])).method
        known = 1000 * float(thesis_value("seconds", datasets[str(row["dataset"])].thesis, method) or np.nan)
        return known, _number(row["median ms"]) / known

    columns = {"thesis ms": ".2f", "ratio to the thesis": ".2f"}
    return _numbered("Tables 4, 6", _extended(table, "75 % ms", columns, beside))


def _grid(config: Config, means: Sequence[Sequence[float]], table: ReportTable) -> ReportTable:
    """Appendices A and B."""
    for count in config.augmentations:

        def ratio(row: Row, count: int = count) -> Sequence[object]:
            step = int(_number(row["steps"]))
            if step > len(means) or count not in THESIS["augmentations"]:
                return (np.nan,)
            return (_number(row[f"{count}"]) / means[step - 1][THESIS["augmentations"].index(count)],)

        table = _extended(table, f"{count} ±", {f"{count} ratio": ".2f"}, ratio)
    return table


def _starts_figure(config: Config, dataset: DatasetResults, in_3d: int, part: ReportFigure) -> ReportFigure:
    """The thesis's means drawn dashed, in the colours of the methods."""
    if not (figures := _FIGURES.get(("starts", dataset.thesis or ""))):
        return part
    (ax,) = part.figure.axes
    for measured in list(ax.containers):
        name = str(measured.get_label())
        if known := thesis_value("starts", dataset.thesis, config.method(name).method):
            label, colour = f"{name}, thesis", measured[0].get_color()
            ax.plot(THESIS["initialisations"], known["mean"], "--", color=colour, alpha=0.5, label=label)
    ax.legend()
    return _numbered(figures[in_3d], replace(part, note=f"{part.note} It is the same in the thesis."))


def _starts_table(config: Config, dataset: DatasetResults, table: ReportTable) -> ReportTable:
    """Appendix C."""
    for plan in config.methods:
        known = thesis_value("starts", dataset.thesis, plan.method)
        if not known or plan.name not in table.columns:
            continue

        def ratio(row: Row, name: str = plan.name, means: Sequence[float] = known["mean"]) -> Sequence[object]:
            if row["initialisations"] not in THESIS["initialisations"]:
                return (np.nan,)
            return (_number(row[name]) / means[THESIS["initialisations"].index(row["initialisations"])],)

        table = _extended(table, f"{plan.name} ±", {f"{plan.name} ratio": ".2f"}, ratio)
    return table


def _pose_changes(pose: PoseResults, config: Config) -> Iterator[_Change]:
    """What is changed of the dataset that the thesis tests pose on."""
    methods = {name: config.method(name).method for name in pose.fitted}
    yield (ReportTable, f"pose-{pose.name}"), partial(_pose, methods)
    yield (ReportTable, f"pose-tests-{pose.name}"), partial(_pose_tests, methods)
    for name, method in methods.items():
        if method in _POSE_FIGURES:
            yield (ReportFigure, f"surface-{pose.name}-{name}"), partial(_numbered, _POSE_FIGURES[method])
        for angle in GRID_ANGLES:
            if method in THESIS["pose_grid"]:
                yield (ReportTable, f"pose-{pose.name}-{name}-{angle}"), partial(_pose_grid, pose, name, method, angle)


def _pose(methods: Mapping[str, str], table: ReportTable) -> ReportTable:
    """Table 7."""

    def beside(row: Row) -> Sequence[object]:
        known = THESIS["pose"].get(methods[str(row["method"])], {}) if row["range"] == "all" else {}
        mean, _ = known.get(str(row["angle"]), (np.nan, np.nan))
        return mean, _number(row["MAE"]) / mean

    columns = {"thesis": ".2f", "ratio to the thesis": ".2f"}
    return _numbered("Table 7", _extended(table, list(table.columns)[-1], columns, beside))


def _pose_tests(methods: Mapping[str, str], table: ReportTable) -> ReportTable:
    def p_value(row: Row) -> Sequence[object]:
        compared = {methods[name] for name in str(row["methods"]).split(", ")} == _COMPARED["3d"]
        return (THESIS["pose_p"].get(row["angle"], np.nan) if compared else np.nan,)

    return _with_rank_sum(table, p_value)


def _pose_grid(pose: PoseResults, name: str, method: str, angle: str, table: ReportTable) -> ReportTable:
    """Appendices D and E, if the true poses are the same."""
    grid = grid_by_pose(pose, name, angle)
    if list(grid.pitches) != THESIS["pitches"] or list(grid.yaws) != THESIS["yaws"]:
        return table
    known = np.array(THESIS["pose_grid"][method][angle], float)
    ratio = float(np.nanmean(grid.mean[~np.isnan(known)]) / np.nanmean(known))
    of_pitch = dict(zip(THESIS["pitches"], known.tolist(), strict=True))
    pitches, *_, last = table.columns
    columns = {f"{yaw:g} (thesis)": ".1f" for yaw in grid.yaws}
    changed = _extended(table, last, columns, lambda row: of_pitch[row[pitches]])
    return replace(changed, note=f"Mean over these cells: {ratio:.2f} times the thesis's.")


def _number(value: object) -> float:
    """The number in a cell of a table."""
    return float(value)  # type: ignore[arg-type]
