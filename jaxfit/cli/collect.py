"""``jaxfit collect``: find landmarks in a collection of pictures with Ray Data, on this machine or a cluster."""

import argparse

from jaxfit.cli.arguments import (
    add_detector,
    add_heads,
    add_model,
    add_pictures,
    add_refine,
    add_starts,
    add_unshift,
    given_fitting,
    given_unshift,
    untrained_starts,
)
from jaxfit.cli.progress import Bars, say, warn
from jaxfit.data.pictures import find_images
from jaxfit.models.files import read_usual_fits
from jaxfit.runs.collection import fit_collection
from jaxfit.runs.workers import BatchFitter


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "collect",
        help="find landmarks in a collection of pictures, with Ray",
        description="Find landmarks in a collection of pictures with workers of Ray Data (jaxfit[ray]). Writes "
        "Parquet files for groups of pictures, and a manifest of all pictures. A run that was "
        "stopped goes on when it is started again; when pictures were added, only these are fitted.",
    )
    add_pictures(command)
    add_model(command)
    add_detector(command, "finds the faces; unless given, yunet, a small network, or whole for models of other objects")
    add_starts(command, "starts a face; several, for models trained for it, find turned faces")
    add_heads(command)
    add_refine(command)
    add_unshift(command)
    command.add_argument("--out", required=True, metavar="DIR", help="where the results go")
    command.add_argument(
        "--workers", type=int, help="number of worker processes (default: as many as there are cores for)"
    )
    command.add_argument("--cores", type=int, default=1, help="cores that each worker uses (default: 1)")
    command.add_argument(
        "--part", type=int, default=256, metavar="N", help="pictures in each Parquet file (default: 256)"
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Fit and write; 1 if no picture has a face that was fitted, or some are missing."""
    fitting = given_fitting(options)
    fitter = BatchFitter(
        options.model,
        fitting,
        options.refine,
        options.cores,
        options.max_megapixels,
        options.unshift,
        options.heads,
    )
    frame, trained = read_usual_fits(options.model)  # the model itself is loaded by the workers
    warn(untrained_starts(options.model, trained, fitting.starts) + given_unshift(options, frame))
    pictures = find_images(options.pictures, options.recursive)
    with Bars() as bars:
        outcomes = fit_collection(
            pictures,
            options.out,
            fitter,
            workers=options.workers,
            part=options.part,
            progress=bars,
        )
    say("pictures: " + ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items()))
    say(f"written: {options.out}/parts, {options.out}/manifest.parquet")
    return 0 if outcomes["fitted"] and not outcomes["missing"] else 1
