"""``jaxfit suggest``: which pictures to label next, with labels to correct."""

import argparse

from jaxfit.cli.arguments import add_detector, add_pictures, given_search
from jaxfit.cli.progress import Bars, report_problems, say
from jaxfit.data.inputs import require_no_inputs
from jaxfit.data.pictures import find_images
from jaxfit.data.writers.annotations import ANNOTATION_FORMATS
from jaxfit.labels.writing import parse_target, write_labels
from jaxfit.learning.suggest import suggest
from jaxfit.models.files import load


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "suggest",
        help="say which pictures to label next",
        description="Rank pictures without labels by how much a model would learn from them: first those of "
        "which it is unsure and that show other shapes. They are written with the model's fits as "
        "labels, for you to correct in the program that you label with.",
    )
    command.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file")
    add_pictures(command, "pictures without labels")
    command.add_argument("--count", type=int, default=20, help="how many pictures to list (default: 20)")
    command.add_argument(
        "--out",
        required=True,
        metavar="FILE",
        help=f"the labels to write, as FORMAT:PATH with FORMAT one of {', '.join(ANNOTATION_FORMATS)}, or a file that "
        "ends in .tps, .xml, .json or .csv",
    )
    add_detector(command, "what finds the objects, as in jaxfit fit")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Fit, rank and write; 1 if nothing was found at all."""
    format, path = parse_target(options.out)
    pictures = find_images(options.pictures, options.recursive)
    require_no_inputs([path], [options.model, *pictures])
    model = load(options.model)
    how = {"detector": options.detector, "search": given_search(options)}
    with Bars() as bars:
        found = suggest(model, pictures, options.count, progress=bars, **how)
    report_problems([*map(str, found.problems)])
    if not len(found.fits):
        say("nothing was found in any of the pictures")
        return 1
    written, problems = write_labels(found.dataset, format, path)
    report_problems(problems)
    for face, unsure in zip(found.dataset.faces, found.unsure, strict=True):
        say(f"{face.image}: its fits differ by {100 * unsure:.2g} % of its size")
    say(f"{path}: {format}, {written} objects to correct, in the order in which to label them")
    return 0
