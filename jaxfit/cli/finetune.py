"""``jaxfit finetune``: tune all steps of a trained model together."""

import argparse
from dataclasses import fields
from typing import get_type_hints

import numpy as np

from jaxfit.cascade.tuning import Tuning
from jaxfit.cli.arguments import DefaultsInHelp, add_confidence, add_head_model, model_target, require_folds, seed
from jaxfit.cli.labelled_faces import add_faces, add_shared, read_faces, require_people
from jaxfit.cli.progress import Bars, report_problems, say
from jaxfit.data.inputs import require_no_inputs
from jaxfit.data.pictures import GreyPictures
from jaxfit.errors import InputError
from jaxfit.image.disturb import Disturbance
from jaxfit.learning.confidence import learn_confidence, training_of
from jaxfit.learning.finetune import finetune
from jaxfit.models.files import load, save
from jaxfit.schemes.conversions import described

_HELP = {
    "epochs": "how often each face is seen",
    "rate": "of learning, at its highest, relative to the size of what is tuned",
    "batch": "faces a step of the optimiser",
    "dropped": "share of the landmarks that each step does not see",
    "spread": "factor on the spread of the starts",
    "units": "hidden units that each step gets, so that it is more than a linear map",
    "guessed": "weight, relative to labelled landmarks, of missing ones that --head-model guesses",
    "balance": "how evenly faces are drawn over their yaws, which --head-model estimates: 0 as they come, 1 evenly",
    "rotation": "standard deviation, in radians, of how far pictures are turned",
    "log_scale": "standard deviation of the logarithm of how much pictures are scaled",
    "shear": "standard deviation of how much pictures are sheared",
    "blur": "share of the pictures that are blurred",
    "noise": "grey values of noise in pictures",
    "hidden": "share of the pictures in which a part is hidden",
    "covered": "share of the pictures that a part of another picture covers",
    "dark": "share of the pictures that are darkened",
    "coarse": "share of the pictures that get larger pixels",
    "compressed": "share of the pictures that are compressed as JPEG does it",
}


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "finetune",
        help="tune all steps of a trained model together",
        description="Tune all steps of a trained model together, by stochastic gradients of the error that they "
        "leave. A run that was killed goes on where it was when the command is given again.",
        formatter_class=DefaultsInHelp,
    )
    command.add_argument("model", help="a model file, or a bundled model's name")
    add_faces(command)
    add_shared(command)
    add_head_model(command)
    command.add_argument("--out", required=True, metavar="MODEL.safetensors", help="the model file to write")
    command.add_argument(
        "--validation",
        type=float,
        default=0.1,
        metavar="SHARE",
        help="share of the people who are kept aside to choose the best epoch; 0 takes the last epoch",
    )
    command.add_argument("--no-mirror", action="store_true", help="do not learn from mirrored pictures too")
    for kind in (Tuning, Disturbance):
        types = get_type_hints(kind)
        for option in fields(kind):
            if option.name in _HELP:
                command.add_argument(
                    f"--{option.name.replace('_', '-')}",
                    type=types[option.name],
                    default=option.default,
                    metavar="N",
                    help=_HELP[option.name],
                )
    command.add_argument("--seed", type=seed, default=Tuning.seed, help="seed of all random numbers")
    add_confidence(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Fine-tune and save."""
    out = model_target(options.out)
    require_no_inputs([out], [options.model])
    require_folds(options, "confidence")
    model = load(options.model)
    had_confidence = model.confidence is not None
    disturbance = Disturbance(**{option.name: getattr(options, option.name) for option in fields(Disturbance)})
    of_tuning = {option.name: getattr(options, option.name) for option in fields(Tuning) if option.name in _HELP}
    tuning = Tuning(**of_tuning, seed=options.seed, disturbance=disturbance)
    found = read_faces(options, model.scheme)
    if found.scheme != model.scheme:
        raise InputError(
            f"{options.model} has the landmarks {described(model.scheme)}; --data has {described(found.scheme)}: "
            "convert them with "
            f"--scheme {model.scheme.name} (from ibug68), or give them as --share beside others"
        )
    if options.confidence:
        require_people(found, options.confidence)
        training_of(model, options.head_model)
    checkpoint = out.with_name(f"{out.stem}.unfinished")
    read = GreyPictures()
    with Bars() as bars:
        tuned = finetune(
            model,
            found.faces,
            tuning=tuning,
            validation=options.validation,
            mirror=not options.no_mirror and model.scheme.mirror is not None,
            head_model=options.head_model,
            checkpoint=checkpoint,
            progress=bars,
            read=read,
        )
        model = tuned.model
        if options.confidence:
            model = learn_confidence(
                model, found.faces, folds=options.confidence, head_model=options.head_model, read=read, progress=bars
            )
    save(model, out)
    checkpoint.unlink(missing_ok=True)
    report_problems([*found.problems, *tuned.problems])
    say(f"{out}: fine-tuned on {tuned.faces} faces, {out.stat().st_size / 2**20:.1f} MiB")
    if options.validation:
        best = int(np.nanargmin(tuned.errors))
        before, after = tuned.errors[[0, best]]
        say(
            f"people kept aside: mean error {after:.4f} of the face's side after epoch {best}, {before:.4f} before"
            if best
            else f"people kept aside: no epoch was better than {before:.4f} of the face's side: the model is unchanged"
        )
    if had_confidence and not options.confidence:
        say("its confidence belonged to the model before fine-tuning and was removed: --confidence learns it anew")
    return 0
