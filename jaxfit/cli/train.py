"""``jaxfit train``: learn a model from labelled faces."""

import argparse
import os
from pathlib import Path

from jaxfit.cli.arguments import add_datasets, add_training, read_datasets, shared_scheme, training_options
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.records import Dataset, FaceRecord
from jaxfit.exceptions import InputError
from jaxfit.lifting import lift_labels
from jaxfit.models.files import SUFFIX, save
from jaxfit.models.heads import load_head
from jaxfit.training import METHODS, train


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
    add_datasets(command)
    command.add_argument("--out", required=True, metavar=f"MODEL{SUFFIX}", help="the model file to write")
    command.add_argument("--method", choices=sorted(METHODS), default="sdm", help="what to train")
    command.add_argument(
        "--lift",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="more datasets, of other or incomplete landmarks: a 3D head model (--head) gives them those of --data",
    )
    command.add_argument(
        "--lift-yaw", type=float, default=0.0, metavar="DEGREES", help="of those, only faces turned so far or farther"
    )
    command.add_argument(
        "--without",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="datasets to be tested on: faces in pictures with the file names of theirs are left out of all others",
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
    if options.lift_yaw and not options.lift:
        raise InputError("--lift-yaw says which faces of --lift are taken; give that too")
    datasets = read_datasets(options.data, options.scheme)
    scheme = shared_scheme(datasets)
    faces = [face for dataset in datasets for face in dataset.faces]
    problems = [problem for dataset in datasets for problem in dataset.problems]
    for dataset in read_datasets(options.lift, None):
        lifted = lift_labels(dataset.faces, dataset.scheme, scheme, load_head(options.head), options.lift_yaw)
        faces += lifted.faces
        problems += [*dataset.problems, *(f"{dataset.spec}: {problem}" for problem in lifted.problems)]
        print(f"{dataset.spec}: {len(lifted.faces)} of {len(dataset.faces)} faces lifted to {scheme.name}")
    faces = _without(faces, read_datasets(options.without, None))
    with Bars() as bars:
        trained = train(
            faces,
            scheme,
            method=options.method,
            options=training_options(options, scheme, options.method),
            progress=bars,
        )
    save(trained.model, out)
    report_problems(problems + list(trained.problems))
    if METHODS[options.method].in_3d or options.lift:
        print(f"3D shape model: {load_head(options.head).source}")
    size = out.stat().st_size / 2**20
    print(f"{out}: {options.method}, {scheme.name}, trained on {trained.faces} faces, {size:.1f} MiB")
    known = trained.model.known_placements
    print(f"boxes it knows: {', '.join(known)}")
    if not options.no_haar and len(known) == 1:
        print("the Haar detectors found too few of the faces to learn how their boxes lie: fit it with --boxes")
    return 0


def _without(faces: list[FaceRecord], tested: list[Dataset]) -> list[FaceRecord]:
    """The faces in other pictures than those of the tested datasets; says how many are not.

    By the names of the files: AFLW2000-3D's pictures are AFLW's, cut and scaled, under the same names.
    """
    for dataset in tested:
        names = {face.image.name for face in dataset.faces}
        kept = [face for face in faces if face.image.name not in names]
        print(f"{len(faces) - len(kept)} of {len(faces)} faces left out: {dataset.spec} has their pictures")
        faces = kept
    return faces
