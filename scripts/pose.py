"""Head pose of models: errors, tables by true pitch and yaw, surfaces, and error against that of the landmarks.

Fits start from the labels' squares, or, in datasets without landmarks, from the dataset's own boxes. How faces lie in
those is measured on frontal pictures of all other subjects than the one that is tested.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib import pyplot
from report import Report, measure, save_figure, script_parser
from scipy.spatial.transform import Rotation

import jaxfit
from jaxfit.cli.arguments import add_datasets, out_folder
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.errors import InputError
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.evaluate import Evaluation
from jaxfit.evaluation.plots import plot_pose_surface
from jaxfit.evaluation.pose import (
    POSE_COLUMNS,
    compare_pose,
    grid_centres,
    pose_errors,
    pose_grid,
    pose_grid_table,
    pose_rows,
)
from jaxfit.evaluation.tables import COMPARISON_COLUMNS, markdown_table
from jaxfit.heads.with_heads import ensure_heads
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import Dataset
from jaxfit.learning.placements import evaluate_pose
from jaxfit.models.model import Model
from jaxfit.schemes.known import IBUG68
from jaxfit.shapes.camera import ANGLES

GROUPS = 8  # of faces by landmark error


def main() -> int:
    parser = script_parser(__doc__, out="tables and figures")
    parser.add_argument(
        "models", nargs="+", metavar="NAME=MODEL", help="models, compared with one another; 2D ones with heads"
    )
    add_datasets(parser)
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    models = named_models(arguments.models)
    folder = out_folder(arguments.out)
    report.title = f"Head pose: {folder.name}"
    report.add("Degrees; faces without a fit count in the median.")
    datasets = read_datasets(arguments.data, arguments.scheme)
    formats = [dataset.spec.partition(":")[0] for dataset in datasets]
    if len(set(formats)) < len(formats):
        raise InputError(f"expected datasets of different formats, which name the figures; got {' '.join(formats)}")
    for dataset in datasets:
        add_dataset(report, models, dataset, folder)


def named_models(texts: Sequence[str]) -> dict[str, Model]:
    """The models by the names that they are given, else by those of their files; names go into file names."""
    models: dict[str, Model] = {}
    for text in texts:
        name, _, path = text.rpartition("=")
        name, model = name or Path(path).stem, ensure_heads(jaxfit.load(path))
        if name in models or "/" in name:
            raise InputError(f"expected models under names of their own, NAME=MODEL; got {' '.join(texts)}")
        models[name] = model
    return models


def add_dataset(report: Report, models: Mapping[str, Model], dataset: Dataset, folder: Path) -> None:
    """Add the tables of a dataset; its figures go into the folder."""
    name = dataset.spec.partition(":")[0]
    with Bars() as bars:
        results = evaluate_pose(models, dataset, progress=bars)
    report_problems(
        [*dataset.problems, *(str(problem) for result in results.values() for problem in result.fits.problems)]
    )
    rows = [{"model": label, **row} for label, result in results.items() for row in rows_with_beyond(result)]
    people = np.unique([face.subject for face in dataset.faces])
    heading = f"## {name}: {len(dataset.faces)} faces of {len(people)} people"
    report.table(rows, {"model": "", **POSE_COLUMNS}, above=heading)
    errors = {label: pose_errors(result.ordered_pose, result.true_pose) for label, result in results.items()}
    tests = [
        {"model": other, "compared with": one, **row}
        for one, other in combinations(errors, 2)
        for row in compare_pose(errors[other], errors[one], subjects_of(results[one]))
    ]
    if tests:
        columns = {"model": "", "compared with": "", "angle": "", **COMPARISON_COLUMNS}
        above = "Tests of absolute errors; the signed-rank test takes the pictures of one person together:"
        report.table(tests, columns, above=above)
    centres = grid_centres(next(iter(results.values())).true_pose)
    for angle, bins in zip(("pitch", "yaw"), centres, strict=True):
        report.add(fitted_by_true(results, angle, bins))
    for label, result in results.items():
        figure = pyplot.figure(figsize=(11, 4.5), layout="constrained")
        for column, angle in enumerate(("pitch", "yaw"), 1):
            grid = pose_grid(errors[label][:, ANGLES.index(angle)], result.true_pose, *centres)
            ax = figure.add_subplot(1, 2, column, projection="3d")
            plot_pose_surface(grid, ax, f"{label}: {angle} error")
            title = f"### {name}, {label}: mean absolute {angle} error by true pitch (rows) and yaw"
            report.add(title, pose_grid_table(grid))
        save_figure(figure, folder / f"{name}-{label}.png", dpi=70)
        pyplot.close(figure)
        report.add(f"![the two tables as surfaces]({name}-{label}.png)")
    if dataset.scheme == IBUG68:
        report.add(against_landmarks(results, folder / f"{name}-geometry.png"))


def rows_with_beyond(result: Evaluation) -> list[dict[str, object]]:
    """The rows of ``pose_rows``, and those of the faces that are turned farther."""
    subjects = subjects_of(result)
    fitted, truth = result.ordered_pose, result.true_pose
    beyond = np.abs(truth[:, ANGLES.index("yaw")]) > 45
    farther = pose_rows(fitted[beyond], truth[beyond], subjects[beyond])
    return [
        *pose_rows(fitted, truth, subjects),
        *({**row, "range": "|yaw| > 45°"} for row in farther if row["range"] == "all"),
    ]


def subjects_of(result: Evaluation) -> np.ndarray:
    return np.array([face.subject for face in result.faces])


def fitted_by_true(results: Mapping[str, Evaluation], angle: str, centres: np.ndarray | None) -> str:
    """The mean fitted angle by the true one: whether a method, or a label, takes poses for milder ones."""
    column, rows = ANGLES.index(angle), []
    for label, result in results.items():
        fitted, truth = result.ordered_pose[:, column], result.true_pose[:, column]
        known = np.isfinite(fitted) & np.isfinite(truth)
        labels = np.unique(truth[np.isfinite(truth)]) if centres is None else centres
        nearest = np.abs(truth[known, None] - labels).argmin(1)
        groups = [fitted[known][nearest == k] for k in range(len(labels))]
        means = [group.mean() if len(group) else np.nan for group in groups]
        rows.append({"model": label, **{f"{value:g}": mean for value, mean in zip(labels, means, strict=True)}})
    columns = {"model": "", **dict.fromkeys(list(rows[0])[1:], ".0f")}
    return f"Mean fitted {angle} where the true one is (nearest to) so many degrees:\n\n{markdown_table(rows, columns)}"


def against_landmarks(results: Mapping[str, Evaluation], path: Path) -> str:
    """How the error of the head's rotation grows with that of its landmarks (thesis 5.4)."""
    figure, ax = pyplot.subplots(figsize=(7, 4.5), layout="constrained")
    rows = []
    for label, result in results.items():
        truth = np.array([face.landmarks for face in result.faces])
        # Over the bounding square: the distance of the eye corners vanishes on profiles.
        landmark_errors = nmed(result.landmarks, truth, IBUG68, "box")
        turned = rotation_errors(result.ordered_pose, result.true_pose)
        known = np.isfinite(landmark_errors) & np.isfinite(turned)
        order = np.flatnonzero(known)[np.argsort(landmark_errors[known])]
        if len(order) < GROUPS:
            return f"Fewer than {GROUPS} faces have landmarks and a pose: too few to compare their errors."
        groups = np.array_split(order, GROUPS)
        centres = [float(np.median(landmark_errors[group])) for group in groups]
        medians = [float(np.median(turned[group])) for group in groups]
        spread = [np.percentile(turned[group], [25, 75]) for group in groups]
        ax.plot(centres, medians, "o-", label=label)
        ax.fill_between(centres, *np.transpose(spread), alpha=0.15)
        rows.append(
            {
                "model": label,
                **{
                    f"group {k}": f"{c:.3f}: {m:.1f}°" for k, (c, m) in enumerate(zip(centres, medians, strict=True), 1)
                },
            }
        )
    ax.set(
        xlabel="landmark error, share of the face's bounding square",
        ylabel="angle to the true rotation, degrees",
        xscale="log",
        yscale="log",
    )
    ax.legend()
    ax.grid(alpha=0.3)
    save_figure(figure, path, dpi=80)
    pyplot.close(figure)
    return (
        f"Median angle between fitted and true rotation by landmark error (of the bounding square), {GROUPS} groups "
        "of equally many faces:\n\n"
        + markdown_table(rows, {name: "" for name in rows[0]})
        + f"\n\n![the same, with quartiles]({path.name})"
    )


def rotation_errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(N,) angles in degrees between rotations given as AFLW2000's roll, pitch, yaw; NaN where one is unknown."""
    known = np.isfinite(poses).all(1) & np.isfinite(truth).all(1)
    turns = [Rotation.from_euler("XYZ", p[known][:, [1, 2, 0]] * [-1, 1, 1], degrees=True) for p in (poses, truth)]
    apart = np.full(len(poses), np.nan)
    apart[known] = np.degrees((turns[0].inv() * turns[1]).magnitude())
    return apart


if __name__ == "__main__":
    sys.exit(main())
