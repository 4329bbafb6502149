"""The labelled faces that are learned from: what the arguments say, and reading them."""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

from jaxfit.cli.arguments import add_datasets, read_datasets, shared_scheme
from jaxfit.cli.progress import say
from jaxfit.errors import InputError
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.heads.model import load_head_model
from jaxfit.labels.datasets import parse_spec
from jaxfit.labels.lifting import fill_labels, lift_labels, share_labels
from jaxfit.labels.records import Dataset, FaceRecord, copies_of
from jaxfit.models.digests import same_pictures
from jaxfit.schemes.scheme import Scheme


@dataclass(frozen=True)
class LabelledFaces:
    """Faces of one scheme from several datasets.

    Attributes:
        faces: the faces; some may lack landmarks.
        scheme: what their landmarks mean.
        problems: what could not be read or lifted and why, a sentence each.
    """

    faces: list[FaceRecord]
    scheme: Scheme
    problems: list[str]


def add_faces(command: argparse.ArgumentParser) -> None:
    """``--data``, ``--scheme``, ``--fill``, ``--lift``, ``--lift-yaw`` and ``--without``."""
    add_datasets(command)
    command.set_defaults(share=[])
    command.add_argument(
        "--fill",
        action="store_true",
        help="give incomplete faces of --data their missing landmarks by a 3D head model (--head-model), instead of "
        "leaving them out",
    )
    command.add_argument(
        "--lift",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="more datasets, of other or incomplete landmarks: a 3D head model (--head-model) gives them those of "
        "--data",
    )
    command.add_argument(
        "--lift-yaw", type=float, default=0.0, metavar="DEGREES", help="of those, only faces turned so far or farther"
    )
    command.add_argument(
        "--without",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="datasets to be tested on: faces in their pictures, or in others of the same file names or pixels, are "
        "left out of all others",
    )


def add_shared(command: argparse.ArgumentParser) -> None:
    """``--share``."""
    command.add_argument(
        "--share",
        nargs="+",
        default=[],
        metavar="SPEC",
        help="more datasets, of other landmarks: those that both have teach (see --head-model)",
    )


def read_faces(arguments: argparse.Namespace) -> LabelledFaces:
    """The faces of ``--data``, filled if ``--fill`` says so, of ``--lift``, and of ``--share``, if the command has it,
    less those of ``--without``.

    Raises:
        InputError: datasets of several schemes, no such dataset, or ``--lift-yaw`` without ``--lift``.
    """
    if arguments.lift_yaw and not arguments.lift:
        raise InputError("--lift-yaw says which faces of --lift are taken; give that too")
    datasets = read_datasets(arguments.data, arguments.scheme)
    scheme = shared_scheme(datasets)
    parts = [list(dataset.faces) for dataset in datasets]
    sources = [_source(dataset) for dataset in datasets]
    problems = [problem for dataset in datasets for problem in dataset.problems]
    if arguments.fill:
        head = load_head_model(arguments.head_model)
        filled = [fill_labels(part, scheme, head) for part in parts]
        parts = [list(part.faces) for part in filled]
        problems += [
            f"{dataset.spec}: {problem}"
            for dataset, part in zip(datasets, filled, strict=True)
            for problem in part.problems
        ]
    others = [
        *((dataset, lift_labels, arguments.lift_yaw, "lifted to") for dataset in read_datasets(arguments.lift, None)),
        *((dataset, share_labels, 0.0, "that share points with") for dataset in read_datasets(arguments.share, None)),
    ]
    for dataset, through_head, least_yaw, done in others:
        found = through_head(dataset.faces, dataset.scheme, scheme, load_head_model(arguments.head_model), least_yaw)
        parts.append(list(found.faces))
        sources.append(_source(dataset))
        problems += [*dataset.problems, *(f"{dataset.spec}: {problem}" for problem in found.problems)]
        say(f"{dataset.spec}: {len(found.faces)} of {len(dataset.faces)} faces {done} {scheme.name}")
    for tested in read_datasets(arguments.without, None):
        parts = _without(parts, tested)
    # A person of the same name in another dataset is another person, but one of a dataset that is lifted and shared.
    faces = [
        replace(face, subject=f"{sources.index(source)}/{face.subject}")
        for source, part in zip(sources, parts, strict=True)
        for face in part
    ]
    return LabelledFaces(faces, scheme, problems)


def require_people(found: LabelledFaces, folds: int | None) -> None:
    """Refuse more folds than there are people, before the work.

    Raises:
        InputError: there are more.
    """
    if folds:
        split_by_subject([face.subject for face in found.faces], folds, 0)


def _source(dataset: Dataset) -> Path:
    """Where a dataset lies, whatever is made of its labels."""
    return Path(parse_spec(dataset.spec)[2]).resolve()


def _without(parts: list[list[FaceRecord]], tested: Dataset) -> list[list[FaceRecord]]:
    """The faces of several datasets in other pictures than those of a tested one; prints how many are not."""
    pictures = [face.image for face in tested.faces]
    copies: dict[Path, Path] = {}
    for part in parts:
        copies |= copies_of(pictures, [face.image for face in part])
    renamed = same_pictures(pictures, {face.image for part in parts for face in part} - {*copies})
    copies |= renamed
    kept = [[face for face in part if face.image not in copies] for part in parts]
    every, left = (sum(map(len, some)) for some in (parts, kept))
    elsewhere = [(copy, of) for copy, of in copies.items() if copy not in renamed and copy.resolve() != of.resolve()]
    how = "".join(
        f"; some by their {what}, such as {some[0][0]} for {some[0][1]}"
        for what, some in (("names", elsewhere), ("pixels", sorted(renamed.items())))
        if some
    )
    say(f"{every - left} of {every} faces left out: {tested.spec} has their pictures{how}")
    return kept
