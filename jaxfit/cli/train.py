"""``jaxfit train``: learn a model from labelled faces."""

import argparse
import os
from pathlib import Path

from jaxfit.cli.arguments import add_training, training_options
from jaxfit.cli.labelled_faces import add_faces, read_faces
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.images import GreyPictures, read_grey
from jaxfit.exceptions import InputError
from jaxfit.models.files import SUFFIX, save
from jaxfit.models.heads import load_head
from jaxfit.training import METHODS, train
from jaxfit.trusting import learn_confidence


class _Defaults(argparse.ArgumentDefaultsHelpFormatter):
    """Says the defaults of options that have one."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        return action.help if action.default is None else super()._get_help_string(action)


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "train",
        help="learn a model from labelled faces",
        description="Learn a model from labelled faces. Faces with missing landmarks are left out and counted.",
        formatter_class=_Defaults,
    )
    add_faces(command)
    command.add_argument("--out", required=True, metavar=f"MODEL{SUFFIX}", help="the model file to write")
    command.add_argument("--method", choices=sorted(METHODS), default="sdm", help="what to train")
    command.add_argument(
        "--confidence",
        type=int,
        nargs="?",
        const=3,
        metavar="FOLDS",
        help="also learn how likely a fit is good (fits.confidence), from fits by models that are trained on parts of "
        "the faces: 3 unless told, which takes four times as long",
    )
    add_training(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Train and save."""
    out = Path(options.out)
    if out.suffix != SUFFIX or out.is_dir() or not os.access(out.parent, os.W_OK):
        # Better before an hour of training than after it.
        raise InputError(
            f"--out: expected a file name ending in {SUFFIX} in a folder that can be written to; got {out}"
        )
    if options.confidence is not None and options.confidence < 2:
        raise InputError(f"--confidence: expected 2 folds or more; got {options.confidence}")
    found = read_faces(options)
    read = GreyPictures() if options.confidence else read_grey
    with Bars() as bars:
        trained = train(
            found.faces,
            found.scheme,
            method=options.method,
            options=training_options(options, found.scheme, options.method),
            progress=bars,
            read=read,
        )
        model = trained.model
        if options.confidence:
            model = learn_confidence(model, found.faces, folds=options.confidence, read=read, progress=bars)
    save(model, out)
    report_problems([*found.problems, *trained.problems])
    if METHODS[options.method].in_3d or options.lift:
        print(f"3D shape model: {load_head(options.head).source}")
    size = out.stat().st_size / 2**20
    print(f"{out}: {options.method}, {found.scheme.name}, trained on {trained.faces} faces, {size:.1f} MiB")
    known = model.known_placements
    print(f"boxes it knows: {', '.join(known)}")
    if not options.no_haar and len(known) == 1:
        print("the Haar detectors found too few of the faces to learn how their boxes lie: fit it with --boxes")
    return 0
