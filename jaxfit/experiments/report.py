"""The report of an experiment: tables and figures of what was run, beside the thesis's numbers where asked for."""

from pathlib import Path

import numpy as np

from jaxfit.experiments.page import write_files
from jaxfit.experiments.report_errors import Group, comparison, grid_tables, parameters, starts_tables, times
from jaxfit.experiments.report_faces import fits_figure, gallery
from jaxfit.experiments.report_parts import Report, Section
from jaxfit.experiments.report_pose import pose_grids, pose_summary
from jaxfit.experiments.results import DatasetResults, ExperimentResults, read_results
from jaxfit.experiments.thesis.comparison import with_thesis
from jaxfit.schemes.normalisers import NORMALISERS

_GALLERY_FACES = 150  # of each dataset
_FIGURE_FACES = 6  # of each dataset


def write_report(folder: Path, target: Path, pictures: bool = True) -> int:
    """Write the report of the experiment in a folder, as far as it has been run.

    Args:
        folder: of the experiment.
        target: the folder to write ``report.html``, tables and figures into.
        pictures: show pictures of faces; without, their landmarks alone.

    Returns:
        How many tasks are not run yet.

    Raises:
        InputError: there is no experiment, a result is damaged, or matplotlib or jinja2 is missing.
    """
    results = read_results(folder)
    write_files(build_report(results, pictures), target)
    return results.missing


def build_report(results: ExperimentResults, pictures: bool = True) -> Report:
    """The report of an experiment; what was not run is left out.

    Args:
        results: what was run.
        pictures: show pictures of faces; without, their landmarks alone.

    Raises:
        InputError: matplotlib is missing.
    """
    report = _own_report(results, pictures)
    return with_thesis(report, results) if results.config.names_thesis else report


def _own_report(results: ExperimentResults, pictures: bool) -> Report:
    """The report without anything of the thesis."""
    config = results.config
    in_2d = Group(False, "2D", tuple(plan for plan in config.methods if not plan.in_3d))
    in_3d = Group(True, "3D", tuple(plan for plan in config.methods if plan.in_3d))
    groups = [group for group in (in_2d, in_3d) if group.plans]
    about = {
        "run": f"{results.tasks - results.missing} of {results.tasks} tasks, {results.hours:.1f} hours of one process",
        "left out": f"{results.waiting} tasks, until those of all folds are run" if results.waiting else "",
        "faces": ", ".join(map(_faces_of, results.datasets)),
        "poses": ", ".join(pose.title for pose in results.pose),
        "cross-validation": f"{config.folds} folds, split by subject, seed {config.seed}",
        "compared": f"models of {config.chosen_augmentations} augmentations and {config.chosen_steps} steps",
        "errors": f"normalised mean Euclidean distance over {NORMALISERS[config.normaliser].title}"
        + ("; of 3D methods in 3D" if in_3d.plans else ""),
        "run with": "; ".join(results.made_with),
    }
    shown = [
        fits_figure(dataset, config, tested, _FIGURE_FACES, pictures)
        for dataset in results.datasets
        for group in groups
        if (tested := dataset.tested(group.plans, config))
    ]
    faces = gallery(results.datasets, config, _GALLERY_FACES, pictures)
    sections = [
        Section(
            "Parameters",
            (
                "Errors over the numbers of cascade steps, augmentations and initialisations. One training of all "
                "steps gives the errors after each of them.",
            ),
            tuple(part for group in groups for part in parameters(results, group)),
            name="parameters",
        ),
        Section("2D methods", (), tuple(comparison(results, in_2d)), name="methods-2d"),
        Section("3D methods", (), tuple(comparison(results, in_3d)), name="methods-3d"),
        Section("Times", (), tuple(times(results)), name="times"),
        Section("Pose", (), tuple(part for pose in results.pose for part in pose_summary(pose)), name="pose"),
        Section(
            "Fitted faces",
            ("Labels in red, fits in cyan: the best, those between, and the worst.",),
            (*shown, *([faces] if faces.faces else [])),
            name="faces",
        ),
        Section(
            "The grid",
            ("Mean errors after each number of steps (rows), by augmentations.",),
            tuple(grid_tables(results)),
            name="grid",
        ),
        Section("Initialisations", (), tuple(starts_tables(results)), name="starts"),
        Section(
            "Pose by true pose",
            ("Mean absolute errors in degrees by true pitch (rows) and yaw.",),
            tuple(table for pose in results.pose for table in pose_grids(pose)),
            name="pose-grids",
        ),
    ]
    sections = [section for section in sections if section.parts]
    if not sections:
        sections.append(Section("Nothing to show", ("No task that a table or figure needs has been run yet.",)))
    if results.problems:
        sections.append(Section("Problems", results.problems, name="problems"))
    return Report("Experiments", {term: fact for term, fact in about.items() if fact}, tuple(sections))


def _faces_of(dataset: DatasetResults) -> str:
    return f"{dataset.name} {len(dataset.subjects)} of {len(np.unique(dataset.subjects))} subjects"
