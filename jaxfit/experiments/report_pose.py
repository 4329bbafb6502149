"""What a report says of pose: errors, tests, surfaces, and the appendices D and E."""

from collections.abc import Iterator
from itertools import combinations
from typing import Any

import numpy as np

from jaxfit.evaluation.plots import new_figure, plot_pose_surface
from jaxfit.evaluation.pose import (
    POSE_COLUMNS,
    PoseGrid,
    grid_centres,
    pose_errors,
    pose_grid,
    pose_grid_columns,
    pose_grid_rows,
    pose_rows,
)
from jaxfit.experiments.config import Config
from jaxfit.experiments.document import Figure, Table
from jaxfit.experiments.report_errors import DIFFERENCES, add_holm, difference_row
from jaxfit.experiments.results import PoseResults
from jaxfit.experiments.thesis import THESIS
from jaxfit.shapes.camera import ANGLES

_FIGURES = {"alignment3d": "Figure 20. ", "regression3d": "Figure 21. "}


def pose_summary(pose: PoseResults, config: Config) -> Iterator[Table | Figure]:
    """Errors of each angle (Table 7), tests of differences, and errors by true pose (Figures 20 and 21)."""
    rows = []
    for name, fitted in pose.fitted.items():
        for row in pose_rows(fitted, pose.truth, pose.subjects):
            known = _of_thesis(pose, "pose", config.method(name).method) if row["range"] == "all" else {}
            mean, _ = known.get(str(row["angle"]), (np.nan, np.nan))
            rows.append({"method": name, **row, "thesis": mean, "ratio to the thesis": row["MAE"] / mean})
    columns = {"method": "", **POSE_COLUMNS, "thesis": ".2f", "ratio to the thesis": ".2f"}
    title = f"{'Table 7. ' if _like_thesis(pose) else ''}{pose.name}: errors of pose, degrees"
    note = f"{pose.told}. ± 95 %: half the interval of the mean, by person; pictures of one are not independent."
    yield Table(f"pose-{pose.name}", title, columns, tuple(rows), note)
    yield from _tests(pose, config)
    for name in pose.fitted:
        grids = {angle: _by_pose(pose, name, angle) for angle in ("pitch", "yaw")}
        if all(grid.count.any() for grid in grids.values()):
            figure = new_figure(11.0, 4.5)
            for column, (angle, grid) in enumerate(grids.items(), 1):
                plot_pose_surface(grid, figure.add_subplot(1, 2, column, projection="3d"), f"{angle} error")
            number = _FIGURES.get(config.method(name).method, "") if _like_thesis(pose) else ""
            yield Figure(f"surface-{pose.name}-{name}", f"{number}{pose.name}, {name}: errors by true pose", figure)


def _tests(pose: PoseResults, config: Config) -> Iterator[Table]:
    errors = {name: np.abs(pose_errors(fitted, pose.truth)) for name, fitted in pose.fitted.items()}
    tests: list[dict[str, object]] = []
    for one, other in combinations(errors, 2):
        compared = {config.method(name).method for name in (one, other)} == _FIGURES.keys() and _like_thesis(pose)
        for column, angle in enumerate(ANGLES):
            if np.isnan(errors[one][:, column]).all():
                continue
            difference = difference_row(errors[other][:, column], errors[one][:, column], pose.subjects)
            thesis = THESIS["pose_p"].get(angle, np.nan) if compared else np.nan
            tests.append({"methods": f"{one}, {other}", "angle": angle, **difference, "thesis's rank-sum p": thesis})
    if tests:
        add_holm(tests)
        note = (
            "Of the second method from the first. The rank-sum test, the thesis's, takes pictures for independent, "
            "which those of one person are not; the signed-rank test pairs the means of each person. Holm's values are "
            "adjusted for all tests of the table."
        )
        columns = {"methods": "", "angle": "", **DIFFERENCES}
        yield Table(f"pose-tests-{pose.name}", f"{pose.told}: differences between methods", columns, tuple(tests), note)


def pose_grids(pose: PoseResults, config: Config) -> Iterator[Table]:
    """Mean absolute errors by true pitch and yaw (Appendices D and E)."""
    for name in pose.fitted:
        for angle in ("pitch", "yaw"):
            grid = _by_pose(pose, name, angle)
            if not grid.count.any():
                continue
            rows, columns, note = pose_grid_rows(grid), pose_grid_columns(grid), ""
            known = _of_thesis(pose, "pose_grid", config.method(name).method)
            if known and list(grid.pitches) == THESIS["pitches"] and list(grid.yaws) == THESIS["yaws"]:
                thesis = np.array(known[angle], float)
                ratio = float(np.nanmean(grid.mean[~np.isnan(thesis)]) / np.nanmean(thesis))
                note = f"Mean over these cells: {ratio:.2f} times the thesis's."
                headings = [f"{yaw:g} (thesis)" for yaw in grid.yaws]
                columns |= dict.fromkeys(headings, ".1f")
                for row, values in zip(rows, thesis, strict=True):
                    row |= dict(zip(headings, map(float, values), strict=True))
            title = f"{pose.name}, {name}: {angle} errors"
            yield Table(f"pose-{pose.name}-{name}-{angle}", title, columns, tuple(rows), note)


def _like_thesis(pose: PoseResults) -> bool:
    return pose.name == "pointing04"


def _of_thesis(pose: PoseResults, part: str, method: str) -> dict[str, Any]:
    """What a part of the thesis's numbers says of a method, by angle; nothing of other datasets."""
    return THESIS[part].get(method, {}) if _like_thesis(pose) else {}


def _by_pose(pose: PoseResults, method: str, angle: str) -> PoseGrid:
    errors = pose_errors(pose.fitted[method], pose.truth)[:, ANGLES.index(angle)]
    return pose_grid(errors, pose.truth, *grid_centres(pose.truth))
