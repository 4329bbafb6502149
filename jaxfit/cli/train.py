"""``jaxfit train``: learn a model from labelled faces."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from jaxfit.cli.arguments import (
    DefaultsInHelp,
    add_confidence,
    add_training,
    model_target,
    require_folds,
    training_options,
)
from jaxfit.cli.labelled_faces import add_faces, read_faces, require_people
from jaxfit.cli.progress import Bars, report_problems, say
from jaxfit.cli.together import add_processes
from jaxfit.data.pictures import GreyPictures, Read, read_grey
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.statistics import summarise
from jaxfit.evaluation.tables import text_table
from jaxfit.heads.model import load_head_model
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.choose import OPTIONS, Chosen, choose_options
from jaxfit.learning.confidence import learn_confidence
from jaxfit.learning.methods import METHODS
from jaxfit.learning.train import train
from jaxfit.models.files import SUFFIX, save
from jaxfit.models.model import Model
from jaxfit.processes import is_first, require_alone
from jaxfit.schemes.normalisers import NORMALISERS
from jaxfit.types import Progress

_MEASURED = 256  # faces at most whose errors are said in the end


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "train",
        help="learn a model from labelled faces",
        description="Learn a model from labelled faces. Faces with missing landmarks are left out and counted.",
        formatter_class=DefaultsInHelp,
    )
    add_faces(command)
    command.add_argument("--out", required=True, metavar=f"MODEL{SUFFIX}", help="the model file to write")
    command.add_argument("--method", choices=sorted(METHODS), default="sdm", help="what to train")
    command.add_argument(
        "--choose",
        type=int,
        nargs="?",
        const=3,
        metavar="FOLDS",
        help="choose ridge, variance, spread and windows, beginning with those given, by the errors that cascades "
        "leave on people that they did not learn from, in cross-validation: in 3 folds by default; takes several "
        "times as long",
    )
    add_confidence(command)
    add_training(command)
    add_processes(command, run)


def run(options: argparse.Namespace) -> int:
    """Train and save."""
    out = model_target(options.out)
    require_folds(options, "choose", "confidence")
    if options.choose:
        require_alone("choosing options")
    if options.confidence:
        require_alone("learning a confidence")
    found = read_faces(options)
    require_people(found, options.confidence)
    read = GreyPictures() if options.confidence or options.choose else read_grey
    of_training = training_options(options, found.scheme, options.method)
    chosen = None
    with Bars() as bars:
        how: dict[str, Any] = {"method": options.method, "progress": bars, "read": read}
        if options.choose:
            chosen = choose_options(found.faces, found.scheme, options=of_training, folds=options.choose, **how)
            of_training = chosen.options
        trained = train(found.faces, found.scheme, options=of_training, **how)
        model = chosen.recorded(trained.model) if chosen else trained.model
        if options.confidence:
            model = learn_confidence(
                model, found.faces, folds=options.confidence, head_model=options.head_model, read=read, progress=bars
            )
        if is_first():
            save(model, out)
        reached = _reached(model, found.faces, read, bars)
    if not is_first():
        return 0
    report_problems([*found.problems, *trained.problems])
    if chosen:
        say(choices_table(chosen))
    if METHODS[options.method].in_3d or options.lift:
        say(f"3D shape model: {load_head_model(options.head_model).source}")
    size = out.stat().st_size / 2**20
    say(f"{out}: {options.method}, {found.scheme.name}, trained on {trained.faces} faces, {size:.1f} MiB")
    say(reached)
    known = model.known_placements
    say(f"boxes it knows: {', '.join(known)}")
    if not options.no_detectors and len(known) == 1:
        say("the detectors found too few of the faces to learn how their boxes lie: fit it with --boxes")
    return 0


def _reached(model: Model, faces: Sequence[FaceRecord], read: Read, progress: Progress) -> str:
    """What errors the model leaves on some of the faces that it learned from."""
    complete = [face for face in faces if face.complete]
    some = complete[:: -(-len(complete) // _MEASURED)]
    found = evaluate(model, some, start_boxes(some), read=read, progress=progress)
    errors = summarise(found.errors)
    return (
        f"on {len(some)} of the faces that it learned from: median error {errors.median:.4f}, relative to "
        f"{NORMALISERS[found.normaliser].title}; on others it errs more: jaxfit evaluate"
    )


def choices_table(chosen: Chosen) -> str:
    """The settings that were tried, as a table; the last line says which ones were chosen."""
    columns = {"option": "", "value": "", "faces": "d", "error": ".4f", "best": ".4f", "p": ".2g", "taken": ""}
    rows = [
        asdict(choice) | {"value": _as_text(choice.value), "taken": ["no", "yes"][choice.taken]}
        for choice in chosen.choices
    ]
    options = chosen.options.flat()
    taken = ", ".join(f"{name} {_as_text(options[name])}" for name in OPTIONS)
    return f"{text_table(rows, columns)}\nchosen: {taken}"


def _as_text(value: float | tuple[float, ...]) -> str:
    """A number or several, as the command line takes them."""
    return " ".join(f"{number:.3g}" for number in np.atleast_1d(value))
