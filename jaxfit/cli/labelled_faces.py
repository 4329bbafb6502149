"""Arguments that say which labelled faces are learned from."""

import argparse

from jaxfit.cli.arguments import add_datasets
from jaxfit.cli.progress import say
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.labels.gather import LabelledFaces, gather_faces
from jaxfit.schemes.scheme import Scheme


def add_faces(command: argparse.ArgumentParser) -> None:
    """``--data``, ``--scheme``, ``--fill``, ``--lift``, ``--lift-yaw`` and ``--without``."""
    add_datasets(command)
    command.set_defaults(share=[])
    command.add_argument(
        "--fill",
        action="store_true",
        help="fill in missing landmarks of --data with a 3D head model (--head-model), instead of leaving these "
        "faces out",
    )
    command.add_argument(
        "--lift",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="more datasets, with other or incomplete landmarks: a 3D head model (--head-model) finds the "
        "landmarks of --data in them",
    )
    command.add_argument(
        "--lift-yaw",
        type=float,
        default=0.0,
        metavar="DEGREES",
        help="from --lift, take only faces that are turned by this much or more",
    )
    command.add_argument(
        "--without",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="datasets to test on later: faces in their pictures, or in pictures of the same file names or "
        "pixels, are left out of all others",
    )


def add_shared(command: argparse.ArgumentParser) -> None:
    """``--share``."""
    command.add_argument(
        "--share",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="more datasets, with other landmarks, of which those that both schemes have are learned (see "
        "--head-model)",
    )


def read_faces(arguments: argparse.Namespace, scheme_of_model: Scheme | None = None) -> LabelledFaces:
    """The faces that the arguments name; what was done to get them is printed.

    Raises:
        InputError, DatasetError: as `jaxfit.labels.gather_faces`.
    """
    found = gather_faces(
        arguments.data,
        scheme=arguments.scheme,
        scheme_of_model=scheme_of_model,
        fill=arguments.fill,
        lift=arguments.lift,
        lift_yaw=arguments.lift_yaw,
        share=arguments.share,
        without=arguments.without,
        head_model=arguments.head_model,
    )
    for note in found.notes:
        say(note)
    return found


def require_people(found: LabelledFaces, folds: int | None) -> None:
    """Refuse more folds than there are people, before the work.

    Raises:
        InputError: there are more.
    """
    if folds:
        split_by_subject([face.subject for face in found.faces], folds, 0)
