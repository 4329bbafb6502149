"""What a report says of pose: errors, tests, and errors by true pose."""

from collections.abc import Iterator
from itertools import combinations

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
from jaxfit.experiments.report_errors import DIFFERENCES, add_holm, difference_row
from jaxfit.experiments.report_parts import ReportFigure, ReportTable
from jaxfit.experiments.results import PoseResults
from jaxfit.shapes.camera import ANGLES

GRID_ANGLES = ("pitch", "yaw")  # whose errors are shown by true pose


def pose_summary(pose: PoseResults) -> Iterator[ReportTable | ReportFigure]:
    """Errors of each angle, tests of differences, and errors by true pose."""
    rows = tuple(
        {"method": name, **row}
        for name, fitted in pose.fitted.items()
        for row in pose_rows(fitted, pose.truth, pose.subjects)
    )
    note = f"{pose.title}. ± 95 %: half the interval of the mean, by person; pictures of one are not independent."
    columns = {"method": "", **POSE_COLUMNS}
    yield ReportTable(f"pose-{pose.name}", f"{pose.name}: errors of pose, degrees", columns, rows, note)
    yield from _tests(pose)
    for name in pose.fitted:
        grids = {angle: grid_by_pose(pose, name, angle) for angle in GRID_ANGLES}
        if all(grid.count.any() for grid in grids.values()):
            figure = new_figure(11.0, 4.5)
            for column, (angle, grid) in enumerate(grids.items(), 1):
                plot_pose_surface(grid, figure.add_subplot(1, 2, column, projection="3d"), f"{angle} error")
            yield ReportFigure(f"surface-{pose.name}-{name}", f"{pose.name}, {name}: errors by true pose", figure)


def _tests(pose: PoseResults) -> Iterator[ReportTable]:
    errors = {name: np.abs(pose_errors(fitted, pose.truth)) for name, fitted in pose.fitted.items()}
    tests: list[dict[str, object]] = []
    for one, other in combinations(errors, 2):
        for column, angle in enumerate(ANGLES):
            if np.isnan(errors[one][:, column]).all():
                continue
            difference = difference_row(errors[other][:, column], errors[one][:, column], pose.subjects)
            tests.append({"methods": f"{one}, {other}", "angle": angle, **difference})
    if tests:
        add_holm(tests)
        note = (
            "The second method compared with the first. The rank-sum test assumes that pictures are independent, which "
            "those of one person are not; the signed-rank test pairs the means of each person. Holm's values are "
            "adjusted for all tests of the table."
        )
        title = f"{pose.title}: differences between methods"
        columns = {"methods": "", "angle": "", **DIFFERENCES}
        yield ReportTable(f"pose-tests-{pose.name}", title, columns, tuple(tests), note)


def pose_grids(pose: PoseResults) -> Iterator[ReportTable]:
    """Mean absolute errors by true pitch and yaw."""
    for name in pose.fitted:
        for angle in GRID_ANGLES:
            grid = grid_by_pose(pose, name, angle)
            if grid.count.any():
                title = f"{pose.name}, {name}: {angle} errors"
                rows = tuple(pose_grid_rows(grid))
                yield ReportTable(f"pose-{pose.name}-{name}-{angle}", title, pose_grid_columns(grid), rows)


def grid_by_pose(pose: PoseResults, method: str, angle: str) -> PoseGrid:
    """The mean absolute errors of an angle that a method found, by true pose."""
    errors = pose_errors(pose.fitted[method], pose.truth)[:, ANGLES.index(angle)]
    return pose_grid(errors, pose.truth, *grid_centres(pose.truth))
