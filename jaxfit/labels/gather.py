"""Faces to learn from, gathered from several datasets: filled, lifted, and without those that are tested on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxfit.errors import InputError
from jaxfit.heads.model import DEFAULT_HEAD_MODEL, load_head_model
from jaxfit.labels.datasets import convert_dataset, parse_spec, read_datasets, shared_scheme
from jaxfit.labels.lifting import fill_labels, lift_labels, share_labels
from jaxfit.labels.records import Dataset, FaceRecord, copies_of
from jaxfit.models.digests import same_pictures
from jaxfit.schemes.conversions import convertible
from jaxfit.schemes.known import SCHEMES
from jaxfit.schemes.scheme import Scheme


@dataclass(frozen=True)
class LabelledFaces:
    """Faces of one scheme from several datasets.

    Attributes:
        faces: the faces; some may lack landmarks.
        scheme: what their landmarks mean.
        problems: what could not be read or lifted and why, a sentence each.
        notes: how many faces were lifted, shared and left out, a sentence each.
    """

    faces: tuple[FaceRecord, ...]
    scheme: Scheme
    problems: tuple[str, ...]
    notes: tuple[str, ...]


def gather_faces(
    data: Sequence[str],
    *,
    scheme: str | Mapping[str, Any] | None = None,
    scheme_of_model: Scheme | None = None,
    fill: bool = False,
    lift: Sequence[str] = (),
    lift_yaw: float = 0.0,
    share: Sequence[str] = (),
    without: Sequence[str] = (),
    head_model: str | Path = DEFAULT_HEAD_MODEL,
) -> LabelledFaces:
    """The faces of datasets, ``FORMAT:PATH`` as in ``jaxfit.read_dataset``, as `jaxfit train` and `finetune` take them.

    A person has the dataset's place in the name, so that people of several datasets are not taken for one.

    Args:
        data: datasets of one scheme.
        scheme: the scheme that their labels are converted to, as ``--scheme`` takes it.
        scheme_of_model: what the landmarks of the model to learn mean; without ``scheme``, labels of as many points
            that are of no known scheme are taken for these.
        fill: give incomplete faces their missing landmarks by the 3D head model (`fill_labels`).
        lift: datasets of other or incomplete landmarks, which the head model gives those of ``data`` (`lift_labels`).
        lift_yaw: of these datasets, only faces that are turned by at least this many degrees.
        share: datasets of other landmarks, of which those that both have are taken (`share_labels`).
        without: datasets to be tested on: faces in their pictures, or in others of the same file names
            or pixels, are left out.
        head_model: a bundled one's name, or a file.

    Raises:
        InputError: no datasets, some of several schemes, one that is named twice, labels that cannot be converted, or
            ``lift_yaw`` without ``lift``.
        DatasetError: a dataset cannot be read.
        ModelError: no such head model.
    """
    if not data:
        raise InputError("expected datasets to learn from; got none")
    if lift_yaw and not lift:
        raise InputError("lift_yaw says which faces of the datasets to lift are taken; give these (lift) too")
    notes: list[str] = []
    datasets = read_datasets(data, scheme)
    if scheme_of_model is not None and scheme is None:
        datasets = [_taken_for(scheme_of_model, dataset, notes) for dataset in datasets]
    target = shared_scheme(datasets)
    parts = [list(dataset.faces) for dataset in datasets]
    sources = [_source(dataset) for dataset in datasets]
    problems = [problem for dataset in datasets for problem in dataset.problems]
    if fill:
        head = load_head_model(head_model)
        filled = [fill_labels(part, target, head) for part in parts]
        parts = [list(part.faces) for part in filled]
        problems += [
            f"{dataset.spec}: {problem}"
            for dataset, part in zip(datasets, filled, strict=True)
            for problem in part.problems
        ]
    others = [
        *((dataset, lift_labels, lift_yaw, "lifted to") for dataset in read_datasets(lift)),
        *((dataset, share_labels, 0.0, "that share points with") for dataset in read_datasets(share)),
    ]
    for dataset, through_head, least_yaw, done in others:
        found = through_head(dataset.faces, dataset.scheme, target, load_head_model(head_model), least_yaw)
        parts.append(list(found.faces))
        sources.append(_source(dataset))
        problems += [*dataset.problems, *(f"{dataset.spec}: {problem}" for problem in found.problems)]
        notes.append(f"{dataset.spec}: {len(found.faces)} of {len(dataset.faces)} faces {done} {target.name}")
    for tested in read_datasets(without):
        parts, note = _without(parts, tested)
        notes.append(note)
    # A person of the same name in another dataset is another person, but one of a dataset that is lifted and shared.
    faces = tuple(
        replace(face, subject=f"{sources.index(source)}/{face.subject}")
        for source, part in zip(sources, parts, strict=True)
        for face in part
    )
    return LabelledFaces(faces, target, tuple(problems), tuple(notes))


def _taken_for(scheme: Scheme, dataset: Dataset, notes: list[str]) -> Dataset:
    """The dataset in a scheme, unless its labels are of a known one, or cannot be of this; a known one is noted."""
    if dataset.scheme.name in SCHEMES or not convertible(dataset.scheme, scheme):
        return dataset
    if scheme.name in SCHEMES:
        notes.append(f"{dataset.spec}: labels taken for the model's {scheme.name}")
    return convert_dataset(dataset, scheme)


def _source(dataset: Dataset) -> Path:
    """Where a dataset lies, in whatever format it is read."""
    return Path(parse_spec(dataset.spec)[2]).resolve()


def _without(parts: list[list[FaceRecord]], tested: Dataset) -> tuple[list[list[FaceRecord]], str]:
    """The faces of several datasets in other pictures than those of a tested one; and how many were left out."""
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
    return kept, f"{every - left} of {every} faces left out: {tested.spec} has their pictures{how}"
