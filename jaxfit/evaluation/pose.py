"""Errors of head pose: signed errors, summaries of each angle, and means over true pitch and yaw (section 5.4).

Everywhere here a pose is roll, pitch and yaw in degrees. A fitted pose that is not finite is a face that was not
found, and a true angle that is not finite is unknown. Angles that differ by whole turns are the same.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy

from jaxfit.errors import InputError
from jaxfit.evaluation.statistics import Subjects, bootstrap_ci, finite_or_none, summarise
from jaxfit.evaluation.tables import comparison_row, markdown_table
from jaxfit.shapes.camera import ANGLES
from jaxfit.shapes.pose_order import as_poses, as_triples, wrapped_degrees

# The columns of a table of pose errors in degrees, whose rows ``pose_rows`` makes.
POSE_COLUMNS = {
    "range": "",
    "angle": "",
    "faces": "d",
    "no fit": "d",
    "MAE": ".2f",
    "± 95 %": ".2f",
    "median": ".2f",
    "bias": "+.2f",
    "Spearman": ".3f",
}

# Centres of the cells of grids where true poses are not a few discrete ones.
_PITCHES, _YAWS = np.arange(-60, 61, 30.0), np.arange(-90, 91, 22.5)
_MOST_DISCRETE = 20  # pitches, or yaws
_CORNER = "pitch \\ yaw"  # heads the column of pitches

_FRONTAL = 45.0  # degrees of true yaw, beyond which much of one side of the face is hidden
_RANGE_LABELS = {"all": "all", f"yaw_within_{_FRONTAL:g}": f"|yaw| ≤ {_FRONTAL:g}°"}


def pose_errors(fitted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Signed errors of each angle, fitted minus true, the shorter way round.

    Args:
        fitted: (N, 3) roll, pitch, yaw, degrees; a row that is not finite is a face that was not found.
        truth: (N, 3) of the same faces; NaN where an angle is unknown.

    Returns:
        (N, 3) degrees in [-180, 180); ``inf`` where the face was not found, NaN where the true angle is unknown.

    Raises:
        InputError: the poses are not both (N, 3).
    """
    fitted, truth = as_poses(fitted), as_poses(truth)
    if fitted.shape != truth.shape:
        raise InputError(f"fitted and true poses must be of the same faces; got {len(fitted)} and {len(truth)} poses")
    lost = np.isnan(fitted).any(axis=1, keepdims=True)
    return np.where(lost & ~np.isnan(truth), np.inf, wrapped_degrees(fitted - truth))


@dataclass(frozen=True)
class AngleSummary:
    """What is reported of one angle over a set of faces, in degrees.

    Attributes:
        faces: faces whose true angle is known.
        undetected: those of them that were not found.
        mae: mean absolute error of the found.
        ci95: half the width of the 95 % confidence interval of ``mae``, as in ``Summary``.
        median: median absolute error, in which a face that was not found has the worst of errors.
        bias: mean signed error of the found.
        spearman: rank correlation of fitted and true angles of the found; NaN below three or if either is constant.
    """

    faces: int
    undetected: int
    mae: float
    ci95: float
    median: float
    bias: float
    spearman: float

    def as_json(self) -> dict[str, float | None]:
        """The numbers without the counts for a JSON file; None where one is not finite."""
        values = (self.mae, self.ci95, self.median, self.bias, self.spearman)
        return dict(zip(("mae", "ci95", "median", "bias", "spearman"), map(finite_or_none, values), strict=True))


def summarise_pose(fitted: np.ndarray, truth: np.ndarray, subjects: Subjects = None) -> dict[str, AngleSummary]:
    """Summary of each of ``ANGLES`` for poses (N, 3); see ``pose_errors``.

    Pictures of one person are not independent: ``subjects`` say who is seen on each. What too few faces leave undefined
    is NaN.

    Raises:
        InputError: the poses are not both (N, 3), or there is not one subject a face.
    """
    columns = zip(ANGLES, pose_errors(fitted, truth).T, as_poses(fitted).T, as_poses(truth).T, strict=True)
    return {angle: _summarise_angle(errors, of, true, subjects) for angle, errors, of, true in columns}


def pose_report(fitted: np.ndarray, truth: np.ndarray) -> dict[str, dict[str, object]]:
    """Everything about poses (N, 3) for a JSON file: of all faces, and of those with a true yaw within 45 degrees.

    For each range the numbers of faces with a true angle known and of those not found, and for each angle what
    ``AngleSummary.as_json`` says.

    Raises:
        InputError: the poses are not both (N, 3).
    """
    return {
        key: {
            "faces": int((~np.isnan(errors)).any(axis=1).sum()),
            "undetected": int(np.isinf(errors).any(axis=1).sum()),
            **{angle: summary.as_json() for angle, summary in summaries.items()},
        }
        for key, errors, summaries in _by_range(fitted, truth, None)
    }


def pose_rows(fitted: np.ndarray, truth: np.ndarray, subjects: Subjects = None) -> list[dict[str, object]]:
    """The rows of ``POSE_COLUMNS`` for poses (N, 3), one for each range of yaw and angle.

    Angles of which the truth is unknown throughout a range have no row. Only the median counts faces that were not
    found.

    Raises:
        InputError: the poses are not both (N, 3), or there is not one subject a face.
    """
    rows = []
    for key, _, summaries in _by_range(fitted, truth, subjects):
        for angle, of in summaries.items():
            if of.faces:
                numbers = (of.faces, of.undetected, of.mae, of.ci95, of.median, of.bias, of.spearman)
                rows.append(dict(zip(POSE_COLUMNS, (_RANGE_LABELS[key], angle, *numbers), strict=True)))
    return rows


def pose_intervals(fitted: np.ndarray, truth: np.ndarray, subjects: Subjects = None) -> list[tuple[float, float]]:
    """The 95 % bootstrap intervals of the MAE in each of ``pose_rows``, by subject.

    Raises:
        InputError: the poses are not both (N, 3), or there is not one subject a face.
    """
    return [
        bootstrap_ci(np.where(np.isfinite(column), np.abs(column), np.nan), subjects)
        for _, errors, summaries in _by_range(fitted, truth, subjects, whole=True)
        for column, of in zip(errors.T, summaries.values(), strict=True)
        if of.faces
    ]


def compare_pose(errors: np.ndarray, baseline: np.ndarray, subjects: Subjects = None) -> list[dict[str, object]]:
    """What ``comparison_row`` says of the absolute errors of two methods, for each angle that both could measure.

    Args:
        errors: (N, 3) signed errors, of ``pose_errors``.
        baseline: (N, 3) those of the other method, of the same faces.
        subjects: who is seen on each of the N faces; None if each is a person of its own.

    Raises:
        InputError: the errors are not both (N, 3), or there is not one subject a face.
    """
    columns = zip(ANGLES, as_triples(errors, "pose errors").T, as_triples(baseline, "pose errors").T, strict=True)
    rows = [{"angle": angle, **comparison_row(np.abs(a), np.abs(b), subjects)} for angle, a, b in columns]
    return [row for row in rows if row["faces"]]


@dataclass(frozen=True)
class PoseGrid:
    """Mean absolute errors of one angle over true pitch and yaw (Figures 20 and 21, Appendices D and E).

    Attributes:
        pitches: (P,) true pitches of the rows, degrees, ascending.
        yaws: (Y,) true yaws of the columns, degrees, ascending.
        mean: (P, Y) mean absolute error of the faces found, degrees; NaN without such faces.
        count: (P, Y) faces found, which the mean is of.
        undetected: (P, Y) faces that were not found.
    """

    pitches: np.ndarray
    yaws: np.ndarray
    mean: np.ndarray
    count: np.ndarray
    undetected: np.ndarray


def pose_grid(
    errors: np.ndarray, truth: np.ndarray, pitches: np.ndarray | None = None, yaws: np.ndarray | None = None
) -> PoseGrid:
    """Mean absolute error of one angle by true pitch and yaw; faces where one of the three is unknown are left out.

    Args:
        errors: (N,) signed or absolute errors of the angle: a column of ``pose_errors``.
        truth: (N, 3) true roll, pitch and yaw of the same faces.
        pitches: (P,) centres of the rows, degrees: a face belongs to the nearest, however far. None, for data of
            discrete poses: the distinct true pitches, to 0.01 degrees.
        yaws: (Y,) centres of the columns, likewise.

    Raises:
        InputError: there is not one error and one true pose a face, or the centres are not finite numbers.
    """
    errors, truth = np.abs(np.asarray(errors, dtype=np.float64)), wrapped_degrees(as_poses(truth))
    if errors.shape != truth.shape[:1]:
        raise InputError(f"expected the errors of one angle, one for each of {len(truth)} poses; got {errors.shape}")
    used = ~(np.isnan(errors) | np.isnan(truth[:, 1:]).any(axis=1))
    errors, (_, true_pitch, true_yaw) = errors[used], truth[used].T
    pitches, rows = _bins(true_pitch, pitches)
    yaws, columns = _bins(true_yaw, yaws)
    shape = (len(pitches), len(yaws))
    cells = rows * len(yaws) + columns
    found = np.isfinite(errors)

    def per_cell(faces: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        return np.bincount(cells[faces], weights, minlength=math.prod(shape)).reshape(shape)

    total, count = per_cell(found, errors[found]), per_cell(found)
    mean = np.divide(total, count, out=np.full(shape, np.nan), where=count > 0)
    return PoseGrid(pitches, yaws, mean, count, per_cell(~found))


def grid_centres(truth: np.ndarray) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Pitches and yaws for ``pose_grid``: None where the true poses (N, 3) are discrete, else some that divide them."""
    known = truth[np.isfinite(truth[:, 1:]).all(1)]
    discrete = all(len(np.unique(known[:, ANGLES.index(angle)])) <= _MOST_DISCRETE for angle in ("pitch", "yaw"))
    return (None, None) if discrete else (_PITCHES, _YAWS)


def pose_grid_rows(grid: PoseGrid) -> list[dict[str, object]]:
    """The grid's means, for tables: rows are true pitches and columns true yaws (Appendices D and E)."""
    return [
        {_CORNER: float(pitch), **{f"{yaw:g}": float(mean) for yaw, mean in zip(grid.yaws, means, strict=True)}}
        for pitch, means in zip(grid.pitches, grid.mean, strict=True)
    ]


def pose_grid_columns(grid: PoseGrid) -> dict[str, str]:
    """The columns of ``pose_grid_rows``."""
    return {_CORNER: "g", **{f"{yaw:g}": ".1f" for yaw in grid.yaws}}


def pose_grid_table(grid: PoseGrid) -> str:
    """``pose_grid_rows`` as a Markdown table."""
    return markdown_table(pose_grid_rows(grid), pose_grid_columns(grid))


def _by_range(
    fitted: np.ndarray, truth: np.ndarray, subjects: Subjects, whole: bool = False
) -> list[tuple[str, np.ndarray, dict[str, AngleSummary]]]:
    """For each range of true yaw its key, and the errors (M, 3) and summaries of the faces within; ``whole``: (N, 3),
    NaN of the others."""
    errors = pose_errors(fitted, truth)
    fitted, truth = as_poses(fitted), as_poses(truth)
    frontal = np.abs(wrapped_degrees(truth[:, ANGLES.index("yaw")])) <= _FRONTAL
    masks = (np.ones(len(truth), dtype=bool), frontal)
    return [
        (
            key,
            np.where(within[:, None], errors, np.nan) if whole else errors[within],
            summarise_pose(fitted, np.where(within[:, None], truth, np.nan), subjects),
        )
        for key, within in zip(_RANGE_LABELS, masks, strict=True)
    ]


def _summarise_angle(errors: np.ndarray, fitted: np.ndarray, truth: np.ndarray, subjects: Subjects) -> AngleSummary:
    absolute = summarise(np.abs(errors), subjects=subjects)
    found = np.isfinite(errors)
    return AngleSummary(
        faces=absolute.measured + absolute.failed,
        undetected=absolute.failed,
        mae=absolute.mean,
        ci95=absolute.ci95,
        median=absolute.median,
        bias=float(errors[found].mean()) if found.any() else math.nan,
        spearman=_rank_correlation(wrapped_degrees(fitted[found]), wrapped_degrees(truth[found])),
    )


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's coefficient of (N,) and (N,); NaN below three pairs or if either is constant."""
    if a.size < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    return float(scipy.stats.spearmanr(a, b).statistic)


def _bins(values: np.ndarray, centres: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Ascending centres (C,), and (N,) the index of the one that each value belongs to."""
    if centres is None:
        return np.unique(np.round(values, 2) + 0.0, return_inverse=True)  # + 0.0 turns -0 into 0
    centres = np.unique(np.asarray(centres, dtype=np.float64))
    if not (centres.size and np.isfinite(centres).all()):
        raise InputError(f"a pose grid needs at least one pitch and one yaw, all finite; got {centres}")
    return centres, np.searchsorted((centres[1:] + centres[:-1]) / 2, values)


# Middles of ranges of true yaw, 15 degrees wide, for curves of errors.
YAW_MIDDLES = np.arange(-90.0, 91.0, 15.0)
# The ranges of |yaw| that tables of AFLW2000-3D have, degrees: above the first, up to the second.
YAW_RANGES = ((-1.0, 30.0), (30.0, 60.0), (60.0, 90.0))


def medians_by_yaw(errors: np.ndarray, yaws: np.ndarray, least: int = 5) -> np.ndarray:
    """The median errors (13,) of the faces nearest to each of ``YAW_MIDDLES``; failures count; NaN of fewer than
    ``least`` faces.

    Args:
        errors: (N,) errors, ``inf`` where there is no fit, NaN where none can be measured.
        yaws: (N,) true yaws in degrees, NaN where unknown.
        least: how many faces a median needs.
    """
    nearest = np.round((np.nan_to_num(yaws, nan=999.0) + 90.0) / 15.0)
    some = (errors[(nearest == place) & ~np.isnan(errors)] for place in range(len(YAW_MIDDLES)))
    return np.array([np.median(each) if len(each) >= least else np.nan for each in some])


def means_by_yaw(errors: np.ndarray, yaws: np.ndarray) -> list[float]:
    """The mean errors of fitted faces in each of ``YAW_RANGES`` of |yaw|, NaN without any, and the mean of these."""
    turned = np.abs(yaws)
    means = []
    for low, high in YAW_RANGES:
        within = errors[(turned > low) & (turned <= high) & np.isfinite(errors)]
        means.append(float(within.mean()) if len(within) else math.nan)
    return [*means, float(np.mean(means))]
