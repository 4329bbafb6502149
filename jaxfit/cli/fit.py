"""``jaxfit fit``: find landmarks in pictures, however many, and go on after having been stopped."""

import argparse
from pathlib import Path

from jaxfit.cli.arguments import (
    add_boxes,
    add_camera,
    add_detector,
    add_heads,
    add_model,
    add_pictures,
    add_refine,
    add_starts,
    add_unshift,
    given_fitting,
    given_placing,
    given_unshift,
    untrained_starts,
    unused_rows,
)
from jaxfit.cli.progress import Bars, report_problems, say, warn
from jaxfit.data.pictures import find_images
from jaxfit.data.writers import DEFAULT_FORMATS, WRITERS
from jaxfit.models.files import load
from jaxfit.runs.folder import FolderRun, fit_folder


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "fit",
        help="find landmarks in pictures",
        description="Find landmarks in pictures; with 3D models also the 3D shape and pose of heads. Writes "
        "tables and other formats, pictures with the faces drawn in, and problems.csv. A run that "
        "was stopped goes on when it is started again.",
    )
    add_pictures(command)
    add_model(command)
    add_boxes(command, "a detector finds the faces")
    add_detector(command, "finds the faces; unless given, yunet, a small network, or whole for models of other objects")
    add_starts(command, "starts a face; several, for models trained for it, find turned faces")
    add_heads(command)
    add_refine(command)
    add_camera(command)
    add_unshift(command)
    command.add_argument("--out", required=True, metavar="DIR", help="where the results go")
    command.add_argument(
        "--format",
        nargs="+",
        choices=WRITERS,
        default=list(DEFAULT_FORMATS),
        help=f"what to write (default: {' '.join(DEFAULT_FORMATS)})",
    )
    command.add_argument(
        "--no-overlays", action="store_true", help="do not write pictures with the faces drawn over them"
    )
    command.add_argument(
        "--contact-sheet", action="store_true", help="write one picture with many faces, the doubtful ones first"
    )
    command.add_argument(
        "--min-confidence",
        type=float,
        metavar="C",
        help="write faces with a confidence below C (0 to 1) to doubtful.csv instead of the tables; by default "
        "all faces are in the tables, and the column ok is 1 for those that are more likely good than not",
    )
    command.add_argument(
        "--overwrite",
        action="store_true",
        help="begin anew if there is an unfinished run, and replace results of another command or version",
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Fit and write; 1 if no face was fitted at all."""
    fitting = given_fitting(options)
    how = FolderRun(
        out=options.out,
        model=options.model,
        fitting=fitting,
        boxes=options.boxes,
        folders=tuple(path for path in options.pictures if Path(path).is_dir()),
        box_kind=options.box_kind,
        unshift=options.unshift,
        heads=options.heads,
        refine=options.refine,
        placing=given_placing(options),
        formats=tuple(options.format),
        overlays=not options.no_overlays,
        contact_sheet=options.contact_sheet,
        min_confidence=options.min_confidence,
        overwrite=options.overwrite,
    )
    pictures = find_images(options.pictures, options.recursive)
    model = load(options.model)
    warn(untrained_starts(options.model, model.starts, fitting.starts) + given_unshift(options, model.cascade.frame))
    with Bars() as bars:
        report = fit_folder(how, pictures, progress=bars)
    if report.resumed:
        say(f"going on: {report.resumed} of {report.pictures} pictures were fitted before")
    if report.left_out:
        say(
            f"left out: {len(report.left_out)} pictures that an earlier run wrote to {options.out}, "
            f"such as {report.left_out[0]}"
        )
    problems = [f"{problem.image}: {problem.why}" for problem in report.problems]
    if report.unused:
        problems.append(f"{options.boxes}: {unused_rows(report.unused)}")
    report_problems(problems)
    doubtful = f" ({report.doubtful} of them doubtful)" if report.doubtful else ""
    say(f"pictures: {report.pictures}, faces fitted: {report.faces}{doubtful}, model: {options.model}")
    if options.min_confidence is not None:
        say(
            f"in the tables: {report.faces - report.set_apart} faces; in doubtful.csv: {report.set_apart} with a "
            f"confidence below {options.min_confidence:g}"
        )
    if report.replaced:
        say(report.replaced)
    say(f"written: {', '.join(map(str, report.written))}")
    return 0 if report.faces else 1
