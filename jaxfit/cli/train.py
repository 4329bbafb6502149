"""``jaxfit train``: learn a model from labelled faces."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import jax
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
from jaxfit.cli.progress import Bars, report_problems, say, warn
from jaxfit.cli.together import add_processes
from jaxfit.data.detectors.whole import KIND as WHOLE
from jaxfit.data.pictures import GreyPictures, Read, read_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.evaluate import Evaluation, evaluate
from jaxfit.evaluation.statistics import summarise
from jaxfit.evaluation.tables import text_table
from jaxfit.heads.model import load_head_model
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.choose import OPTIONS, Chosen, choose_options
from jaxfit.learning.confidence import learn_confidence
from jaxfit.learning.held_out import evaluate_held_out
from jaxfit.learning.methods import METHODS
from jaxfit.learning.train import train
from jaxfit.models.files import SUFFIX, save
from jaxfit.models.model import Model
from jaxfit.processes import is_first, require_alone
from jaxfit.schemes.known import SCHEMES
from jaxfit.schemes.normalisers import NORMALISERS
from jaxfit.schemes.scheme import Scheme
from jaxfit.types import Progress

_MEASURED = 256  # faces at most whose errors are said in the end
_FOLDS, _FEW = 5, 100  # of faces of one's own scheme, which are tested in folds if there are no more than these
_TOO_FEW = 20  # faces, below which errors on others are large


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "train",
        help="learn a model from labelled faces",
        description="Learn a model from labelled faces. Faces with missing landmarks are left out and counted.",
        formatter_class=DefaultsInHelp,
    )
    add_faces(command)
    command.add_argument(
        "--out", required=True, metavar=f"MODEL{SUFFIX}", help="the model file to write, in place of one of that name"
    )
    command.add_argument("--method", choices=sorted(METHODS), default="sdm", help="what to train")
    command.add_argument(
        "--choose",
        type=int,
        nargs="?",
        const=3,
        metavar="FOLDS",
        help="choose ridge, variance, spread and windows, beginning with those given, by the errors of cascades "
        "on people that they did not learn from, in cross-validation with 3 folds by default; takes "
        "several times as long",
    )
    command.add_argument(
        "--folds",
        type=int,
        metavar="FOLDS",
        help="at the end, also train FOLDS times without a part of the subjects, and report the errors on that "
        f"part; 0 leaves this out (default: {_FOLDS} for schemes of your own with up to {_FEW} faces, else "
        "0)",
    )
    add_confidence(command)
    add_training(command)
    add_processes(command, run)


def run(options: argparse.Namespace) -> int:
    """Train and save."""
    out = model_target(options.out)
    require_folds(options, "choose", "confidence", *["folds"] * bool(options.folds))
    if options.choose:
        require_alone("choosing options")
    if options.confidence:
        require_alone("learning a confidence")
    found = read_faces(options)
    require_people(found, options.confidence)
    complete = [face for face in found.faces if face.complete]
    folds = _folds(options.folds, complete, found.scheme)
    if folds:
        require_alone("testing in folds")
    read = GreyPictures() if options.confidence or options.choose or folds else read_grey
    of_training = training_options(options, found.scheme, options.method, len(complete))
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
    if folds:
        say(f"{out} is written; {folds} more trainings tell what errors to expect of it (Ctrl-C keeps the model)")
    with bars:
        how |= {"options": of_training, "folds": folds}
        held_out = evaluate_held_out(found.faces, found.scheme, **how) if folds else {}
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
    for kind, result in held_out.items():
        say(_on_others(kind, result, folds))
    if trained.faces < _TOO_FEW:
        warn([f"only {trained.faces} faces to learn from: label at least {_TOO_FEW}, better 50, for lower errors"])
    known = model.known_placements
    say(f"boxes it knows: {', '.join(known)}")
    if not options.no_detectors and len(known) == 1:
        say("the detectors found too few of the faces to learn how their boxes lie: use --boxes to fit")
    return 0


def _folds(given: int | None, faces: Sequence[FaceRecord], scheme: Scheme) -> int:
    """In how many folds a training is tested, of faces that it can learn from; 0: in none."""
    subjects = len({face.subject for face in faces})
    if given is not None:
        if given > subjects:
            raise InputError(f"--folds: expected at most the number of subjects, {subjects}; got {given}")
        return given
    few = scheme.name not in SCHEMES and subjects >= _FOLDS and len(faces) <= _FEW
    return _FOLDS if few and jax.process_count() == 1 else 0


def _on_others(kind: str, result: Evaluation, folds: int) -> str:
    """What errors models left on faces that they had not learned from."""
    errors = result.errors[np.isfinite(result.errors)]
    start = "whole pictures" if kind == WHOLE else "boxes like those around landmarks"
    return (
        f"on faces that it did not learn from, in {folds} folds, from {start}: mean error {errors.mean():.4f}, median "
        f"{np.median(errors):.4f}, 90 % below {np.quantile(errors, 0.9):.4f}, relative to "
        f"{NORMALISERS[result.normaliser].title}; mean {np.nanmean(result.distances):.3g} pixels"
    )


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
