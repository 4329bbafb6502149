"""The report of a comparison: tables, tests, curves and the worst faces of all contestants, side by side."""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from jaxfit.data.names import table_path
from jaxfit.evaluation.compare import Comparison, Entry
from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.plots import new_figure, plot_by_yaw, plot_ced
from jaxfit.evaluation.pose import POSE_COLUMNS, YAW_RANGES, means_by_yaw, pose_errors, pose_intervals, pose_rows
from jaxfit.evaluation.statistics import intervals, rank_biserial
from jaxfit.evaluation.tables import SUMMARY_COLUMNS, summary_row
from jaxfit.experiments.figures import plot_fits
from jaxfit.experiments.names import folder_names
from jaxfit.experiments.report_errors import DIFFERENCES, add_holm, difference_row
from jaxfit.experiments.report_faces import SIDE, Thumbnails, jpeg_of
from jaxfit.experiments.report_parts import Gallery, GalleryFace, Part, Report, ReportFigure, ReportTable, Section
from jaxfit.labels.datasets import parse_spec
from jaxfit.schemes.normalisers import NORMALISERS
from jaxfit.shapes.camera import ANGLES

_CED_LIMIT = 2 * LIMIT  # where curves end
_FIGURE_FACES, _GALLERY_FACES = 8, 60  # of each dataset
_SURE = 0.05  # an adjusted p-value from which nobody is called better

ERRORS = {
    "dataset": "",
    "contestant": "",
    **SUMMARY_COLUMNS,
    "mean of shared": ".4f",
    "relative to": "",
    "points": "",
    "boxes": "",
    "ms/face": ".1f",
}
_RANGED = ("mean", "median", "AUC", "failure")
INTERVALS = {
    "dataset": "",
    "contestant": "",
    **{f"{name} {end}": ".4f" for name in _RANGED for end in ("from", "to")},
    "relative to": "",
}
_TESTED = {"first": "", "second": "", **DIFFERENCES, "effect size": "+.2f", "better": ""}
TESTS = {"dataset": "", **_TESTED, "relative to": ""}
POSES = {"dataset": "", "contestant": "", **POSE_COLUMNS, "MAE from": ".2f", "MAE to": ".2f"}
POSE_TESTS = {"dataset": "", "angle": "", **_TESTED}
_YAW_HEADINGS = [f"{max(low, 0):g} to {high:g}°" for low, high in YAW_RANGES]
BY_YAW = {
    "dataset": "",
    "contestant": "",
    **dict.fromkeys([*_YAW_HEADINGS, "mean of the three"], ".4f"),
    "relative to": "",
}

_ERRORS_NOTE = (
    "The mean is over fitted faces; faces without a fit count in the median, the AUC and the failures. Mean of shared: "
    "over the faces that all contestants fitted. ± 95 %: half the interval of the mean, by subject. Unmeasured: the "
    "labels lack what errors are relative to. Learned from: faces in pictures that a contestant learned from, marked "
    "†, on which errors are no test; unknown: it does not say."
)
_INTERVALS_NOTE = "95 % bootstrap intervals, of whole subjects. AUC and failures are those up to and above 0.08."
_TESTS_NOTE = (
    "The second compared with the first, on the same faces. The rank-sum test assumes that all errors are independent; "
    "the signed-rank test pairs the means of each subject. Holm's values are adjusted for all tests of the table. "
    "Effect size: the matched-pairs rank-biserial correlation, from -1, if the second has the lower error on "
    f"everybody, to 1. Better: who has the lower errors, if Holm's value is below {_SURE:g}."
)
_POSE_NOTE = (
    "Degrees; the MAE is over faces with a pose, the median counts the others as the worst. MAE from, to: 95 % "
    "bootstrap intervals of whole subjects."
)
_YAW_NOTE = "Mean errors of fitted faces by |yaw|, and the mean of the three, as AFLW2000-3D is usually reported."


def build_comparison(
    comparisons: Sequence[Comparison], notes: Sequence[str] = (), title: str = "Comparison", pictures: bool = True
) -> Report:
    """The report of comparisons of the same contestants.

    Args:
        comparisons: one for each dataset.
        notes: what else is to be said, a sentence each.
        title: of the report.
        pictures: show pictures of faces; without, their landmarks alone.

    Raises:
        InputError: matplotlib is missing.
    """
    tables = comparison_tables(comparisons)
    names = dataset_names(comparisons)
    parts: dict[str, list[Part]] = {"errors": [], "poses": [], "faces": []}
    for table in tables:
        parts["poses" if table.name.startswith("pose") else "errors"].append(table)
    worst: list[GalleryFace] = []
    for name, found in zip(names, comparisons, strict=True):
        marked = marked_names(found)
        errors = {marked[each]: values for each, values in found.errors.items()}
        yaws = found.true_pose[:, ANGLES.index("yaw")]
        if errors:
            figure = new_figure(6.5, 4.2)
            plot_ced(errors, _CED_LIMIT, figure.subplots(), _error_of(found))
            parts["errors"].append(ReportFigure(f"ced-{_stem(name)}", f"{name}: cumulative errors", figure))
            if np.isfinite(yaws).any():
                figure = new_figure(6.5, 4.2)
                plot_by_yaw(errors, yaws, figure.subplots(), _error_of(found))
                parts["errors"].append(ReportFigure(f"yaw-{_stem(name)}", f"{name}: errors by yaw", figure))
            parts["faces"].append(_worst_figure(name, found, marked, pictures))
            worst += _gallery_faces(name, found, marked, pictures)
        if found.poses:
            off = {
                marked[each]: np.abs(pose_errors(poses, found.true_pose)).mean(1) for each, poses in found.poses.items()
            }
            figure = new_figure(6.5, 4.2)
            plot_by_yaw(off, yaws, figure.subplots(), "error of the three angles, degrees")
            parts["poses"].append(ReportFigure(f"pose-yaw-{_stem(name)}", f"{name}: pose errors by yaw", figure))
    if worst:
        lines = {name: found.scheme.lines for name, found in zip(names, comparisons, strict=True)}
        note = "Labels in red, fits in cyan; of each contestant its worst faces, in turn."
        parts["faces"].append(Gallery("Worst faces", tuple(worst), lines, note))
    sections = [
        Section("Errors", (), tuple(parts["errors"]), "errors"),
        Section("Poses", (), tuple(parts["poses"]), "poses"),
        Section("Faces", (), tuple(parts["faces"]), "faces"),
        Section("Notes", tuple(notes), (), "notes"),
    ]
    about = {
        "contestants": "; ".join(
            f"{entry.contestant.name}: {table_path(entry.contestant.source)}, boxes: {entry.boxes}"
            for entry in comparisons[0].entries
        ),
        "faces": ", ".join(
            f"{name} {len(found.dataset.faces)} of {len({*found.subjects.tolist()})} subjects"
            for name, found in zip(names, comparisons, strict=True)
        ),
    }
    return Report(title, about, tuple(section for section in sections if section.parts or section.text))


def comparison_tables(comparisons: Sequence[Comparison]) -> list[ReportTable]:
    """All tables of comparisons: errors, their intervals and tests, poses likewise, and errors by yaw; those that are
    empty are left out."""
    rows: dict[str, list[dict[str, object]]] = {
        name: [] for name in ("errors", "intervals", "tests", "by-yaw", "poses", "pose-tests")
    }
    for name, found in zip(dataset_names(comparisons), comparisons, strict=True):
        marked = marked_names(found)
        errors, subjects = found.errors, found.subjects
        shared = np.all([np.isfinite(each) for each in errors.values()], axis=0) if errors else None
        yaws = found.true_pose[:, ANGLES.index("yaw")]
        relative = NORMALISERS[found.normaliser].title
        for entry in found.entries:
            called = {"dataset": name, "contestant": marked[entry.contestant.name]}
            measured = called | {"relative to": relative}
            own = errors.get(entry.contestant.name)
            if own is not None:
                rows["errors"].append(measured | _error_row(found, entry, own, own[shared]))
                rows["intervals"].append(measured | _interval_row(own, subjects))
                if np.isfinite(yaws).any():
                    means = means_by_yaw(own, yaws)
                    rows["by-yaw"].append(
                        measured | dict(zip([*_YAW_HEADINGS, "mean of the three"], means, strict=True))
                    )
            if (poses := found.poses.get(entry.contestant.name)) is not None:
                ends = pose_intervals(poses, found.true_pose, subjects)
                for row, (low, high) in zip(pose_rows(poses, found.true_pose, subjects), ends, strict=True):
                    rows["poses"].append(called | row | {"MAE from": low, "MAE to": high})
        rows["tests"] += [{"dataset": name, "relative to": relative, **row} for row in _tests(errors, subjects, marked)]
        apart = {each: np.abs(pose_errors(poses, found.true_pose)) for each, poses in found.poses.items()}
        for column, angle in enumerate(ANGLES):
            of_angle = {each: values[:, column] for each, values in apart.items()}
            known = {each: values for each, values in of_angle.items() if not np.isnan(values).all()}
            rows["pose-tests"] += [{"dataset": name, "angle": angle, **row} for row in _tests(known, subjects, marked)]
    for tested in ("tests", "pose-tests"):
        add_holm(rows[tested])
        for row in rows[tested]:
            p, effect = row["signed-rank p (Holm)"], row["effect size"]
            assert isinstance(p, float)
            assert isinstance(effect, float)
            row["better"] = row["first" if effect > 0 else "second"] if p < _SURE else "neither"
    all_tables = [
        ReportTable("errors", "Errors", ERRORS, tuple(rows["errors"]), _ERRORS_NOTE),
        ReportTable("intervals", "How sure they are", INTERVALS, tuple(rows["intervals"]), _INTERVALS_NOTE),
        ReportTable("tests", "Differences", TESTS, tuple(rows["tests"]), _TESTS_NOTE),
        ReportTable("by-yaw", "Errors by yaw", BY_YAW, tuple(rows["by-yaw"]), _YAW_NOTE),
        ReportTable("poses", "Errors of pose", POSES, tuple(rows["poses"]), _POSE_NOTE),
        ReportTable("pose-tests", "Differences of pose", POSE_TESTS, tuple(rows["pose-tests"]), _TESTS_NOTE),
    ]
    return [table for table in all_tables if table.rows]


def dataset_names(comparisons: Sequence[Comparison]) -> list[str]:
    """What reports call the datasets: their files or folders."""
    return folder_names([str(Path(parse_spec(found.dataset.spec).path).absolute()) for found in comparisons])


def marked_names(found: Comparison) -> dict[str, str]:
    """What the report calls each contestant: its name, with a † if it learned from some of the pictures."""
    learned = {entry.contestant.name: entry.evaluation.learned for entry in found.entries}
    return {name: f"{name} †" if of is not None and of.any() else name for name, of in learned.items()}


def _stem(name: str) -> str:
    """A name as files can have it."""
    return "-".join(re.findall("[A-Za-z0-9]+", name)) or "faces"


def _error_of(found: Comparison) -> str:
    return f"NMED / {NORMALISERS[found.normaliser].title}"


def _error_row(found: Comparison, entry: Entry, errors: np.ndarray, shared: np.ndarray) -> dict[str, object]:
    return {
        "points": found.scheme.name,
        "boxes": entry.boxes,
        **summary_row(errors, found.subjects, entry.evaluation.learned),
        "mean of shared": float(shared.mean()) if len(shared) else None,
        "ms/face": 1000 * entry.evaluation.seconds_per_face,
    }


def _interval_row(errors: np.ndarray, subjects: np.ndarray) -> dict[str, object]:
    found = intervals(errors, subjects=subjects)
    ends = [end for each in (found.mean, found.median, found.auc, found.failure) for end in each]
    return dict(zip(list(INTERVALS)[2:-1], ends, strict=True))


def _tests(
    errors: Mapping[str, np.ndarray], subjects: np.ndarray, marked: Mapping[str, str]
) -> Iterator[dict[str, object]]:
    for one, other in combinations(errors, 2):
        yield {
            "first": marked[one],
            "second": marked[other],
            **difference_row(errors[other], errors[one], subjects),
            "effect size": rank_biserial(errors[other], errors[one], subjects),
        }


def worst_faces(errors: Mapping[str, np.ndarray], most: int) -> list[int]:
    """Numbers of up to ``most`` faces: of each contestant in turn the worst that it fitted, or, where it fitted none
    of the others, that it missed."""
    orders = []
    for values in errors.values():
        measured = np.flatnonzero(~np.isnan(values))
        fitted = np.isfinite(values[measured])
        orders.append([*measured[fitted][np.argsort(-values[measured][fitted])], *measured[~fitted]])
    rounds = (order[place] for place in range(max(map(len, orders))) for order in orders if place < len(order))
    return [int(number) for number in dict.fromkeys(rounds)][:most]


def _thumbnails(found: Comparison, pictures: bool) -> Thumbnails:
    faces = found.dataset.faces
    return Thumbnails([face.image for face in faces], [face.landmarks for face in faces], pictures)


def _worst_figure(name: str, found: Comparison, marked: Mapping[str, str], pictures: bool) -> ReportFigure:
    numbers = worst_faces(found.errors, _FIGURE_FACES)
    thumbnails = _thumbnails(found, pictures)
    fits = {
        marked[entry.contestant.name]: [
            thumbnails.points(number, entry.evaluation.landmarks[number]) for number in numbers
        ]
        for entry in found.entries
        if entry.contestant.name in found.errors
    }
    figure = plot_fits(
        [thumbnails.picture(number) for number in numbers],
        [thumbnails.points(number, found.dataset.faces[number].landmarks) for number in numbers],
        fits,
        [found.dataset.faces[number].face.rpartition("/")[2][-16:] for number in numbers],
        found.scheme,
        SIDE,
    )
    note = (
        "Labels in red, fits in cyan: of each contestant in turn the worst face that it fitted. Where no fit is drawn, "
        "it has none."
    )
    return ReportFigure(f"worst-{_stem(name)}", f"{name}: the worst faces", figure, note)


def _gallery_faces(name: str, found: Comparison, marked: Mapping[str, str], pictures: bool) -> Iterator[GalleryFace]:
    thumbnails = _thumbnails(found, pictures)
    entries = {marked[entry.contestant.name]: entry for entry in found.entries if entry.contestant.name in found.errors}
    landmarks = {each: entry.evaluation.landmarks for each, entry in entries.items()}
    for number in worst_faces(found.errors, _GALLERY_FACES):
        face, picture = found.dataset.faces[number], thumbnails.picture(number)
        yield GalleryFace(
            dataset=name,
            face=face.face,
            size=SIDE,
            jpeg=None if picture is None else jpeg_of(picture),
            truth=thumbnails.points(number, face.landmarks),
            fits={each: thumbnails.points(number, points[number]) for each, points in landmarks.items()},
            errors={each: float(entry.evaluation.errors[number]) for each, entry in entries.items()},
            yaw=float(found.true_pose[number, 2]),
            pitch=float(found.true_pose[number, 1]),
        )
