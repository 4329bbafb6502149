"""``jaxfit evaluate``: measure a model on labelled faces."""

import argparse
import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from jaxfit.cli.arguments import (
    add_boxes,
    add_datasets,
    add_detector,
    add_heads,
    add_normaliser,
    add_refine,
    add_starts,
    given_fitting,
    seed,
    untrained_starts,
    unused_rows,
)
from jaxfit.cli.progress import Bars, report_problems, say, warn
from jaxfit.cli.together import add_processes
from jaxfit.data.inputs import require_no_inputs
from jaxfit.data.locks import held
from jaxfit.data.outputs import MANIFEST, atomic_write, replace_results, require_own_folder, write_csv
from jaxfit.evaluation.datasets import (
    FACE_COLUMNS,
    EvaluationRun,
    distances_report,
    evaluation_report,
    face_rows,
    plan_evaluation,
)
from jaxfit.evaluation.evaluate import Evaluation
from jaxfit.evaluation.pose import POSE_COLUMNS, pose_rows
from jaxfit.evaluation.statistics import summarise
from jaxfit.evaluation.tables import SUMMARY_COLUMNS, summary_row, text_table
from jaxfit.evaluation.uncertainty import SHARES, uncertainty_report
from jaxfit.heads.with_heads import ensure_heads
from jaxfit.models.files import load
from jaxfit.processes import is_first
from jaxfit.runs.run_folder import file_digests, run_files
from jaxfit.schemes.normalisers import NORMALISERS

_COMMAND, _WRITTEN = "jaxfit evaluate", ("report.json", "faces.csv")
_ERROR_3D = "3D median"
_COLUMNS = {"dataset": "", "relative to": "", **SUMMARY_COLUMNS, _ERROR_3D: ".4f", "ms/face": ".1f"}


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "evaluate",
        help="measure a model on labelled faces",
        description="Measure a model on labelled faces: normalised mean Euclidean distance (NMED), AUC and "
        "failure rate at 0.08; for 3D models also the NMED in 3D and errors of the head's pose. "
        "Faces that are not found or cannot be read count as failures. If labels have another "
        "landmark scheme than the model, they are converted to the model's, or the model's fits to "
        "theirs, or both to what --scheme says.",
    )
    command.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file")
    add_datasets(command)
    add_boxes(
        command,
        "fits start from the true landmarks' bounding square, moved by 6 %% and scaled by 8 %%, or, where there are "
        "no landmarks, from the dataset's own boxes",
    )
    add_detector(command, "start from the boxes in which this detector finds the faces")
    command.add_argument("--seed", type=seed, default=0, help="seed of the random starts (default: 0)")
    add_normaliser(command)
    add_starts(command, "starts a face; several, for models trained for it, find turned faces")
    add_heads(command)
    add_refine(command)
    command.add_argument("--out", required=True, metavar="DIR", help="where report.json and faces.csv go")
    add_processes(command, run)


def run(options: argparse.Namespace) -> int:
    """Evaluate, print the table, write ``report.json`` and ``faces.csv``."""
    with ExitStack() as until_the_end:
        return _evaluate(options, until_the_end)


def _evaluate(options: argparse.Namespace, until_the_end: ExitStack) -> int:
    """What `run` does, in a folder of results that is held from where all requests are known to be right."""
    model = load(options.model)
    model = ensure_heads(model) if options.heads else model
    fitting = given_fitting(options)
    asked = EvaluationRun(
        fitting=fitting,
        boxes=options.boxes,
        box_kind=options.box_kind,
        seed=options.seed,
        scheme=options.scheme,
        normaliser=options.normaliser,
        refine=options.refine,
    )
    plan = plan_evaluation(model, options.data, asked)
    for note in plan.notes:
        say(note)
    datasets = [planned.dataset for planned in plan.datasets]
    require_own_folder(options.out, _COMMAND)
    folder = Path(options.out)
    if is_first():
        until_the_end.enter_context(held(folder, _COMMAND))
    given = [
        options.model,
        *([options.boxes] if options.boxes else []),
        *(face.image for dataset in datasets for face in dataset.faces),
    ]
    require_no_inputs([folder / name for name in (*_WRITTEN, MANIFEST)], given)
    warn(untrained_starts(options.model, model.starts, fitting.starts))
    if plan.unused:
        warn([f"{options.boxes}: {unused_rows(plan.unused)}"])
    with Bars() as bars:
        results = plan.evaluate(bars)
    if not is_first():
        return 0
    kinds = {planned.dataset.spec: planned.box_kind for planned in plan.datasets}
    reports = {spec: {"box_kind": kinds[spec], **evaluation_report(result)} for spec, result in results.items()}
    with atomic_write(folder / _WRITTEN[0], "w") as file:
        settings = {
            "boxes": options.boxes,
            **fitting.settings(),
            "seed": options.seed,
            "heads": options.heads,
            "refine": options.refine,
            "passes": plan.pipeline.passes,
        }
        settings = {"model": options.model, **settings}
        json.dump(settings | {"datasets": reports}, file, indent=2)
    write_csv(folder / _WRITTEN[1], FACE_COLUMNS, face_rows(results))
    settings |= {name: getattr(options, name) for name in ("box_kind", "scheme", "normaliser", "max_megapixels")}
    settings |= file_digests(options.model, run_files(options.model, fitting, options.boxes))
    if replaced := replace_results(folder, _COMMAND, _WRITTEN, settings | {"data": list(reports)}):
        say(replaced)
    report_problems(
        [problem for dataset in datasets for problem in dataset.problems]
        + [str(problem) for result in results.values() for problem in result.fits.problems]
    )
    warn(
        [
            f"{spec}: the model learned from the pictures of {result.learned.sum()} of {len(result.faces)} faces, "
            "whose errors are no test of it"
            for spec, result in results.items()
            if result.learned is not None and result.learned.any()
        ]
    )
    _print_tables(results, solid=model.space_3d is not None)
    say(f"written: {folder / 'report.json'}, {folder / 'faces.csv'}")
    return 0


def _print_tables(results: Mapping[str, Evaluation], solid: bool) -> None:
    """Print the errors of each dataset, and of poses where they are known; ``solid`` models have errors in 3D."""
    columns = {name: form for name, form in _COLUMNS.items() if name != _ERROR_3D or solid}
    say(text_table([_row(spec, result) for spec, result in results.items()], columns))
    say(
        "Errors are NMED, relative to what the table says.\n"
        "The mean is over fitted faces; faces without a fit count in the median, the AUC and the failures.\n"
        "Unmeasured: the points of the normaliser are not labelled.\n"
        "Learned from: faces in pictures that the model was trained on; unknown: the model does not say."
    )
    for spec, result in results.items():
        for unit, numbers in _distances_in_words(result):
            say(f"{spec}: errors of single landmarks in {unit}: {numbers}")
    for spec, result in results.items():
        if words := _uncertainty_in_words(result):
            say(f"{spec}: {words}")
    for spec, result in results.items():
        if result.fits.pose is not None and np.isfinite(result.true_pose).any():
            say(f"\n{spec}: errors of the pose in degrees; faces without a fit count in the median.")
            say(text_table(pose_rows(result.ordered_pose, result.true_pose), POSE_COLUMNS))


def _uncertainty_in_words(result: Evaluation) -> str:
    """How right the regions and the visibility of landmarks are; empty where nothing is known."""
    report = uncertainty_report(result).get("uncertainty", {})
    held = [value for name, value in report.items() if name.startswith("regions") and value is not None]
    if not held:
        return ""
    claimed = ", ".join(f"{share:.0%}" for share in SHARES)
    words = f"regions that claim {claimed} of the landmarks hold {', '.join(f'{value:.0%}' for value in held)}"
    hidden = report["hidden_auroc"]
    return (
        words
        if hidden is None
        else f"{words}; hidden landmarks are told from visible ones with an AUROC of {hidden:.2f}"
    )


def _distances_in_words(result: Evaluation) -> Iterator[tuple[str, str]]:
    """The distances of fitted faces' landmarks from the true ones, by their unit."""
    report = distances_report(result)
    units = report.get("units", {})
    for unit, of_unit in (("pixels", report.get("pixels")), (units.get("unit", ""), units)):
        if of_unit:
            mean, median, high = (of_unit[name] for name in ("mean", "median", "ninety_percent"))
            yield unit, f"mean {mean:.3g}, median {median:.3g}, 90 % below {high:.3g}"


def _row(spec: str, result: Evaluation) -> dict[str, object]:
    median_3d = None if result.errors_3d is None else summarise(result.errors_3d).median
    return {
        "dataset": spec,
        "relative to": NORMALISERS[result.normaliser].title,
        **summary_row(result.errors, [face.subject for face in result.faces], result.learned),
        _ERROR_3D: median_3d,
        "ms/face": result.seconds_per_face * 1000,
    }
