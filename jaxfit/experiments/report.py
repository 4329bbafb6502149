"""The report of an experiment: the thesis's tables and figures from what was run, with the thesis's numbers beside."""

from pathlib import Path

import numpy as np

from jaxfit.experiments.claims import claims
from jaxfit.experiments.document import Document, Section, Table
from jaxfit.experiments.faces import fits_figure, gallery
from jaxfit.experiments.page import write_document
from jaxfit.experiments.report_errors import Group, comparison, grid_tables, parameters, starts_tables, times
from jaxfit.experiments.report_pose import pose_grids, pose_summary
from jaxfit.experiments.results import DatasetResults, Results, read_results
from jaxfit.experiments.thesis import THESIS
from jaxfit.schemes.normalisers import NORMALISER_TITLES

_GALLERY = 150  # faces of each dataset
_SHOWN = 6  # faces of each dataset in a figure


def write_report(folder: Path, target: Path, pictures: bool = True) -> int:
    """Write the report of the experiment in a folder, as far as it has been run.

    Args:
        folder: of the experiment.
        target: the folder to write ``report.html``, tables and figures into.
        pictures: show pictures of faces; without, their landmarks alone.

    Returns:
        How many cells are not run yet.

    Raises:
        InputError: there is no experiment, a result is damaged, or matplotlib or jinja2 is missing.
    """
    results = read_results(folder)
    write_document(document(results, pictures), target)
    return results.missing


def document(results: Results, pictures: bool = True) -> Document:
    """The report of an experiment; what was not run is left out."""
    config = results.config
    flat = Group(False, "2D", "Table 3", tuple(plan for plan in config.methods if not plan.in_3d))
    solid = Group(True, "3D", "Table 5", tuple(plan for plan in config.methods if plan.in_3d))
    groups = [group for group in (flat, solid) if group.plans]
    about = {
        "run": f"{results.cells - results.missing} of {results.cells} cells, {results.hours:.1f} hours of one process",
        "left out": f"{results.waiting} cells, until those of all folds are run" if results.waiting else "",
        "faces": ", ".join(map(_count, results.datasets)),
        "poses": ", ".join(pose.told for pose in results.pose),
        "cross-validation": f"{config.folds} folds, split by subject, seed {config.seed}",
        "compared": f"models of {config.chosen_augmentations} augmentations and {config.chosen_steps} steps",
        "errors": f"normalised mean Euclidean distance (Eq. 16), over {NORMALISER_TITLES[config.normaliser]}; "
        "of 3D methods in 3D",
        "the thesis": THESIS["title"],
        "its numbers": "; ".join(_beside(dataset) for dataset in results.datasets if dataset.thesis),
        "run with": "; ".join(results.made_with),
    }
    shown = [
        fits_figure(dataset, config, tested, _SHOWN, pictures)
        for dataset in results.datasets
        for group in groups
        if (tested := dataset.tested(group.plans, config))
    ]
    faces = gallery(results.datasets, config, _GALLERY, pictures)
    sections = [
        _claims(results),
        Section(
            "Parameters (5.1)",
            (
                "Errors over the numbers of cascade steps, augmentations and initialisations. One training of all "
                "steps gives the errors after each of them.",
            ),
            tuple(part for group in groups for part in parameters(results, group)),
        ),
        Section("2D methods (5.2)", (), tuple(comparison(results, flat))),
        Section("3D methods (5.3)", (), tuple(comparison(results, solid))),
        Section("Times (Tables 4 and 6)", (), tuple(times(results))),
        Section("Pose (5.4)", (), tuple(part for pose in results.pose for part in pose_summary(pose, config))),
        Section(
            "Fitted faces (5.5)",
            ("Labels in red, fits in cyan: the best, those between, and the worst.",),
            (*shown, *([faces] if faces.faces else [])),
        ),
        Section(
            "Appendices A, B: the grid",
            ("Mean errors after each number of steps (rows), by augmentations; ratios are to the thesis's.",),
            tuple(grid_tables(results)),
        ),
        Section("Appendix C: initialisations", (), tuple(starts_tables(results))),
        Section(
            "Appendices D, E: pose by true pose",
            (
                "Mean absolute errors in degrees by true pitch (rows) and yaw. Pitches are Pointing'04's tilts; the "
                "appendices of the thesis print them multiplied by 0.75.",
            ),
            tuple(table for pose in results.pose for table in pose_grids(pose, config)),
        ),
    ]
    sections = [section for section in sections if section.parts]
    if not sections:
        sections.append(Section("Nothing to show", ("No cell that a table or figure needs has been run yet.",)))
    if results.problems:
        sections.append(Section("Problems", results.problems))
    return Document("Experiments", {what: told for what, told in about.items() if told}, tuple(sections))


def _count(dataset: DatasetResults) -> str:
    return f"{dataset.name} {len(dataset.subjects)} of {len(np.unique(dataset.subjects))} subjects"


def _beside(dataset: DatasetResults) -> str:
    known = dataset.thesis or ""
    faces, points = THESIS["faces"][known], THESIS["points"][known]
    return f"beside {dataset.name} ({dataset.scheme.count} points) those of {known} ({points} points, {faces} faces)"


def _claims(results: Results) -> Section:
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
        for claim in claims(results)
    )
    columns = {"": "", "claim": "", "on": "", "here": "", "found": "", "test": "", "p": ".2g", "p (Holm)": ".2g"}
    note = (
        "A claim of a difference holds where the figures are as claimed and Holm's p-value, adjusted for all tests of "
        "the same letter, is below 0.05; one of equality where the 95 % interval of the relative difference of the "
        "means is narrow enough. Not shown: the figures are as claimed, but chance or the faces at hand may have made "
        "them so. Means are over the faces that all fitted. Several pictures of a person are taken together."
    )
    return Section("The thesis's claims", (), (Table("claims", "Claims", columns, rows, note),) if rows else ())
