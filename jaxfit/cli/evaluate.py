"""``jaxfit evaluate``: measure a model on labelled faces."""

import argparse
import json
from collections.abc import Iterator
from contextlib import ExitStack
from math import isfinite, isnan
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.cli.arguments import (
    add_boxes,
    add_datasets,
    add_detector,
    add_refine,
    add_starts,
    given_boxes,
    given_search,
    given_starts,
    read_datasets,
    seed,
    untrained_starts,
    unused_rows,
)
from jaxfit.cli.progress import Bars, report_problems, say
from jaxfit.cli.together import add_processes
from jaxfit.data.boxes import GivenBox, boxes_of_pictures
from jaxfit.data.detectors import Search, detector_named
from jaxfit.data.inputs import require_no_inputs
from jaxfit.data.locks import held
from jaxfit.data.names import plain, table_path, table_word
from jaxfit.data.outputs import MANIFEST, atomic_write, replace_results, require_own_folder, write_csv
from jaxfit.data.pictures import read_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.evaluate import (
    Evaluation,
    detected_boxes,
    fit_labelled,
    measure,
    require_measurable,
    share_boxes,
    start_boxes,
)
from jaxfit.evaluation.pose import POSE_COLUMNS, pose_report, pose_rows
from jaxfit.evaluation.statistics import summarise
from jaxfit.evaluation.tables import SUMMARY_COLUMNS, summary_row, text_table
from jaxfit.fitting.fit import passes_from, passes_from_boxes
from jaxfit.fitting.refine import refine, require_refinable
from jaxfit.fitting.stream import Pipeline
from jaxfit.labels.datasets import convert_dataset, parse_spec
from jaxfit.labels.records import Dataset
from jaxfit.models.files import load
from jaxfit.models.model import SQUARE, Model
from jaxfit.processes import is_first
from jaxfit.schemes.conversions import CONVERSIONS
from jaxfit.schemes.known import NO_LANDMARKS
from jaxfit.schemes.normalisers import NORMALISERS
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import ANGLES

_COMMAND, _WRITTEN = "jaxfit evaluate", ("report.json", "faces.csv")
_ERROR_3D = "3D median"
_COLUMNS = {"dataset": "", "relative to": "", **SUMMARY_COLUMNS, _ERROR_3D: ".4f", "ms/face": ".1f"}
_BOX_COLUMNS = ("x", "y", "width", "height")
_POSE_COLUMNS = tuple(f"{of}{angle}" for of in ("", "true_") for angle in ANGLES)
_MEASURED_COLUMNS = (*_BOX_COLUMNS, "nmed", "nmed_3d", *_POSE_COLUMNS, "pose_order")
_FACE_COLUMNS = ("dataset", "face", "subject", "image", *_MEASURED_COLUMNS, "learned", "problem")


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "evaluate",
        help="measure a model on labelled faces",
        description="Measure a model on labelled faces: normalised mean Euclidean distance (NMED), AUC and failure "
        "rate at 0.08; for 3D models the NMED in 3D and errors of the head's pose as well. Faces that are not found or "
        "cannot be read count as failures. Labels of another landmark scheme than the model's are converted to it "
        "where that is possible; or the model's fits to theirs; or both to what --scheme says.",
    )
    command.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file")
    add_datasets(command)
    add_boxes(
        command,
        "fits start from the true landmarks' bounding square, moved by 6 %% and scaled by 8 %%, or, where there are "
        "no landmarks, from the dataset's own boxes",
    )
    add_detector(command, "start from the boxes in which this detector finds the faces")
    command.add_argument("--seed", type=seed, default=0, help="of those starting squares (default: 0)")
    command.add_argument(
        "--normaliser",
        choices=NORMALISERS,
        help="what distances are divided by: outer eye corners, pupil centres, bounding square (default: the outer eye "
        "corners; the square where labels have none, or faces are turned by over 45 degrees)",
    )
    add_starts(command, "starts a face; several, for models trained for it, find turned faces")
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
    datasets = read_datasets(options.data, options.scheme)
    if options.scheme is None:
        datasets = [_for_model(model, dataset) for dataset in datasets]
    schemes = [_measured_scheme(model, dataset) for dataset in datasets]
    for dataset, scheme in zip(datasets, schemes, strict=True):
        require_measurable(model.scheme, scheme, options.normaliser, dataset.faces)
    named = given_boxes(options, model)
    if named is not None and options.detector is not None:
        raise InputError("expected --boxes or a --detector that finds them; got both")
    starts, search = given_starts(options), given_search(options)
    if options.detector is None and search != Search():
        raise InputError(
            "expected a --detector with --smallest, --score or --any-rotation; got none: name it, or leave these out"
        )
    if options.refine:
        require_refinable(model)
    require_own_folder(options.out, _COMMAND)
    boxes, unused = (None, []) if named is None else _boxes_of_pictures(options.boxes, named, datasets)
    folder = Path(options.out)
    if is_first():
        until_the_end.enter_context(held(folder, _COMMAND))
    given = [
        options.model,
        *([options.boxes] if options.boxes else []),
        *(face.image for dataset in datasets for face in dataset.faces),
    ]
    require_no_inputs([folder / name for name in (*_WRITTEN, MANIFEST)], given)
    kinds = {dataset.spec: _box_kind(options, model, named, dataset) for dataset in datasets}
    if options.detector is not None:
        passes = passes_from(detector_named(options.detector))
    else:
        passes = passes_from_boxes(box.kind for boxes in (named or {}).values() for box in boxes)
    pipeline = Pipeline(model, starts=starts, passes=passes, read=read_grey)
    results: dict[str, Evaluation] = {}
    with Bars() as bars:
        for dataset, scheme in zip(datasets, schemes, strict=True):
            kind: str | list[str] = kinds[dataset.spec]
            turned: np.ndarray | None
            if options.detector is not None:
                begun, kind, turned = detected_boxes(dataset.faces, options.detector, search, bars)
            elif boxes is None:
                begun, turned = start_boxes(dataset.faces, options.seed), None
            else:
                begun, kind, turned = share_boxes(dataset.faces, boxes)
            fits, seconds, learned = fit_labelled(
                pipeline, dataset.faces, begun, kind=kind, rotations=turned, progress=bars
            )
            results[dataset.spec] = measure(
                refine(model, fits) if options.refine else fits,
                dataset.faces,
                scheme=scheme,
                normaliser=options.normaliser,
                model=model,
                seconds_per_face=seconds,
                learned=learned,
            )
    if not is_first():
        return 0
    reports = {spec: {"box_kind": kinds[spec], **_report(result)} for spec, result in results.items()}
    with atomic_write(folder / _WRITTEN[0], "w") as file:
        settings = {
            "boxes": options.boxes,
            "detector": options.detector,
            "search": vars(search),
            "seed": options.seed,
            "starts": starts.count,
            "rotations": [starts.low, starts.high],
            "refine": options.refine,
            "passes": passes,
        }
        json.dump({"model": options.model, **settings, "datasets": reports}, file, indent=2)
    write_csv(folder / _WRITTEN[1], _FACE_COLUMNS, _faces(results))
    if replaced := replace_results(folder, _COMMAND, _WRITTEN, {"model": options.model, "data": list(reports)}):
        say(replaced)
    report_problems(
        untrained_starts(options.model, model, starts)
        + unused
        + [problem for dataset in datasets for problem in dataset.problems]
        + [str(problem) for result in results.values() for problem in result.fits.problems]
    )
    say(
        "NMED, relative to what the table says. The mean is over fitted faces; faces without a fit count in the "
        "median, the AUC and the failures. Unmeasured: the points of the normaliser are not annotated. Learned from: "
        "faces in pictures that the model was trained on, which are no test of it; unknown: the model does not say."
    )
    columns = {name: form for name, form in _COLUMNS.items() if name != _ERROR_3D or model.space_3d is not None}
    say(text_table([_row(spec, result) for spec, result in results.items()], columns))
    for spec, result in results.items():
        if result.fits.pose is not None and np.isfinite(result.true_pose).any():
            say(f"\n{spec}: errors of the pose in degrees; faces without a fit count in the median.")
            say(text_table(pose_rows(result.ordered_pose, result.true_pose), POSE_COLUMNS))
    say(f"written: {folder / 'report.json'}, {folder / 'faces.csv'}")
    return 0


def _boxes_of_pictures(
    file: str, named: dict[str, list[GivenBox]], datasets: list[Dataset]
) -> tuple[dict[Path, list[GivenBox]], list[str]]:
    """The boxes of a file by picture, and a warning of those that no picture has; a name in the file must not mean
    pictures of two datasets either."""
    folders = [Path(file).parent, *(Path(parse_spec(dataset.spec)[2]) for dataset in datasets)]
    folders = [folder if folder.is_dir() else folder.parent for folder in folders]
    try:
        boxes, unused = boxes_of_pictures(
            named, [face.image for dataset in datasets for face in dataset.faces], folders
        )
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    return boxes, [f"{file}: {unused_rows(unused)}"] if unused else []


def _for_model(model: Model, dataset: Dataset) -> Dataset:
    """The dataset in the model's landmark scheme where its labels can be converted, which is said; else as it is."""
    if (dataset.scheme.name, model.scheme.name) not in CONVERSIONS:
        return dataset
    say(f"{dataset.spec}: labels converted from {dataset.scheme.name} to the model's {model.scheme.name}")
    return convert_dataset(dataset, model.scheme)


def _measured_scheme(model: Model, dataset: Dataset) -> Scheme:
    """The scheme that errors are measured in: the labels' own where the model's fits can be converted to it."""
    return dataset.scheme if (model.scheme.name, dataset.scheme.name) in CONVERSIONS else model.scheme


def _box_kind(
    options: argparse.Namespace, model: Model, named: dict[str, list[GivenBox]] | None, dataset: Dataset
) -> str:
    """What draws the boxes that fits start from."""
    if named is not None:
        return ", ".join(sorted({box.kind for boxes in named.values() for box in boxes})) or SQUARE
    return _start_kind(model, dataset) if options.detector is None else str(options.detector)


def _start_kind(model: Model, dataset: Dataset) -> str:
    """The kind of the boxes that fits start from without ``--boxes``: datasets without landmarks have their own."""
    own = parse_spec(dataset.spec)[0]
    if dataset.scheme != NO_LANDMARKS:
        return SQUARE
    if own in model.known_placements:
        return own
    say(f"{dataset.spec}: the model does not know how faces lie in {own} boxes and takes them for {SQUARE} ones")
    return SQUARE


def _report(result: Evaluation) -> dict[str, Any]:
    """One dataset's part of ``report.json``; ``ci95`` is half the width of the mean's 95 % confidence interval."""
    seconds = result.seconds_per_face
    fitted = int(result.fits.fitted.sum())
    return {
        **summarise(result.errors).as_json(),
        "fitted": fitted,
        "undetected": len(result.faces) - fitted,
        "learned_from": None if result.learned is None else int(result.learned.sum()),
        "normaliser": NORMALISERS[result.normaliser].title,
        "seconds_per_face": seconds if isfinite(seconds) else None,
        **_report_3d(result),
    }


def _report_3d(result: Evaluation) -> dict[str, Any]:
    """What is said of 3D models only."""
    if result.fits.pose is None or result.errors_3d is None:
        return {}
    return {
        "nmed_3d": summarise(result.errors_3d).as_json()["nmed"],
        "pose": pose_report(result.ordered_pose, result.true_pose),
        "pose_order": sorted({face.pose_order for face in result.faces if face.pose is not None}),
    }


def _row(spec: str, result: Evaluation) -> dict[str, object]:
    median_3d = None if result.errors_3d is None else summarise(result.errors_3d).median
    return {
        "dataset": spec,
        "relative to": NORMALISERS[result.normaliser].title,
        **summary_row(result.errors, learned=result.learned),
        _ERROR_3D: median_3d,
        "ms/face": result.seconds_per_face * 1000,
    }


def _faces(results: dict[str, Evaluation]) -> Iterator[list[object]]:
    """A row for each face; ``nmed`` is ``inf`` without a fit, ``nan`` where the truth does not allow to measure.

    Fitted angles are in the order of the labelled ones, and may be others than those of ``jaxfit fit``.
    """
    for spec, result in results.items():
        why = {problem.row: str(problem) for problem in result.fits.problems}
        for number, face in enumerate(result.faces):
            box = [f"{value:.3f}" for value in result.fits.boxes[number]]
            error = result.errors[number]
            error_3d = "" if result.errors_3d is None else f"{result.errors_3d[number]:.6f}"
            angles = np.concatenate([result.ordered_pose[number], result.true_pose[number]])
            pose = ["" if isnan(angle) else f"{angle:.3f}" for angle in angles]
            problem = why.get(number, "the normaliser's points are not annotated" if isnan(error) else "")
            numbers = [*box, f"{error:.6f}", error_3d, *pose]
            names = [table_word(face.face), table_word(face.subject), table_path(face.image)]
            learned = "" if result.learned is None else int(result.learned[number])
            yield [plain(spec), *names, *numbers, face.pose_order, learned, table_word(problem)]
