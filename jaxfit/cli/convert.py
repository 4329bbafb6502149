"""``jaxfit convert``: labels, or fitted landmarks, from one format into another."""

import argparse
from pathlib import Path

from jaxfit.cli.arguments import add_max_megapixels, add_scheme
from jaxfit.cli.progress import report_problems, say
from jaxfit.data.inputs import require_no_inputs
from jaxfit.data.writers.annotations import ANNOTATION_FORMATS
from jaxfit.labels.datasets import FORMATS, parse_spec, read_datasets
from jaxfit.labels.writing import parse_target, write_labels


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "convert",
        help="write labels in another format",
        description="Write labels, or fitted landmarks, in the format of another program, and say what that "
        "format cannot hold. Pictures are named by their paths from the folder of OUT.",
    )
    command.add_argument(
        "source",
        metavar="IN",
        help=f"labels as FORMAT:PATH, with FORMAT one of {', '.join(FORMATS)}; or a file that ends in .tps, .xml, "
        ".json or .csv, such as a landmarks.csv",
    )
    command.add_argument(
        "out",
        metavar="OUT",
        help=f"the file to write, in the same form, with FORMAT one of {', '.join(ANNOTATION_FORMATS)}; for pts "
        "a folder: that of the pictures, so that the files can be read again",
    )
    add_scheme(command)
    add_max_megapixels(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read and write."""
    format, path = parse_target(options.out)
    (dataset,) = read_datasets([options.source], options.scheme)
    given = [Path(parse_spec(options.source).path), *(face.image for face in dataset.faces)]
    require_no_inputs([path], given)
    written, problems = write_labels(dataset, format, path)
    report_problems([*dataset.problems, *problems])
    say(f"{path}: {format}, {written} of {len(dataset.faces)} objects with {dataset.scheme.count} points")
    return 0 if written else 1
