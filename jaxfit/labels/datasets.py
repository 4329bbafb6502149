"""The formats of labelled faces by the names that the command line uses, ``FORMAT:PATH``; conversion of labels."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfit.data.names import real_path
from jaxfit.errors import InputError
from jaxfit.labels.importers.aflw import read_aflw
from jaxfit.labels.importers.aflw2000 import read_aflw2000
from jaxfit.labels.importers.lfpw import read_lfpw
from jaxfit.labels.importers.pointing04 import read_pointing04
from jaxfit.labels.importers.pts_folder import read_pts_folder
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.labels.turned import as_seen, noticed
from jaxfit.schemes.conversions import convert, sources
from jaxfit.schemes.known import scheme_named
from jaxfit.schemes.scheme import Scheme

# A reader gets the path and returns the labelled faces, at least one of them with its picture, or raises DatasetError.
FORMATS: dict[str, Callable[[Path], Dataset]] = {
    "pts": read_pts_folder,
    "pts0": partial(read_pts_folder, base=0),
    "aflw": read_aflw,
    "lfpw": read_lfpw,
    "pointing04": read_pointing04,
    "aflw2000": read_aflw2000,
    "aflw2000-all": partial(read_aflw2000, most_degrees=math.inf),
}


class Spec(NamedTuple):
    """What ``FORMAT:PATH``, ``FORMAT+PIXELS:PATH`` or ``FORMAT@stored:PATH`` says.

    Attributes:
        format: one of ``FORMATS``.
        shift: by how many pixels labels are moved.
        path: of the dataset.
        stored: whether labels belong to pixels as they are stored, instead of to pictures as they are seen.
    """

    format: str
    shift: float
    path: str
    stored: bool


def parse_spec(spec: str) -> Spec:
    """The parts of ``FORMAT:PATH``, ``FORMAT+PIXELS:PATH``, ``FORMAT@stored:PATH`` or ``FORMAT@stored+PIXELS:PATH``.

    Raises:
        InputError: no path, or an unknown format.
    """
    name, _, path = spec.partition(":")
    known = re.fullmatch(r"(.+?)(@stored)?([+-][0-9]*\.?[0-9]+)?", name)
    if not known or known[1] not in FORMATS or not path:
        raise InputError(f"expected a dataset as FORMAT:PATH with FORMAT one of {', '.join(FORMATS)}; got {spec!r}")
    return Spec(known[1], float(known[3] or 0), path, known[2] is not None)


def read_dataset(spec: str) -> Dataset:
    """The dataset that ``spec``, ``FORMAT:PATH``, names.

    ``FORMAT+PIXELS:PATH`` moves the labels right and down by so many pixels when they are read, ``FORMAT-PIXELS:PATH``
    left and up, so that datasets whose labels count pixels differently can be used together. Labels belong to pictures
    as they are seen, which EXIF data may turn; those of ``FORMAT@stored:PATH`` belong to the pixels as they are stored,
    and are turned with their pictures. A problem names pictures that this makes a difference to.

    Raises:
        InputError: no path, or an unknown format.
        DatasetError: the dataset is missing, damaged, or has no face that can be used.
    """
    name, shift, path, stored = parse_spec(spec)
    found = FORMATS[name](Path(path))
    moved = tuple(replace(face, landmarks=face.landmarks + shift) for face in found.faces) if shift else found.faces
    dataset = replace(found, faces=moved, spec=spec)
    return as_seen(dataset) if stored else noticed(dataset, spec, f"{name}@stored{spec[len(name) :]}")


def convert_dataset(dataset: Dataset, scheme: Scheme) -> Dataset:
    """The dataset with its labels converted to ``scheme``; all else stays as it is.

    A converted landmark is present, or visible, where all landmarks that it is made of are.

    Raises:
        InputError: labels of this kind cannot be converted to ``scheme``, or there are no landmarks to convert.
    """
    if not dataset.scheme.count:
        raise InputError(f"{dataset.spec}: its faces have no landmarks that could be converted to {scheme.name}")
    try:
        made_of = [list(indices) for indices in sources(dataset.scheme, scheme)]
    except InputError as error:
        raise InputError(f"{dataset.spec}: {error}") from None

    def converted(face: FaceRecord) -> FaceRecord:
        return replace(
            face,
            landmarks=convert(face.landmarks, dataset.scheme, scheme),
            present=np.array([face.present[indices].all() for indices in made_of]),
            visible=np.array([face.visible[indices].all() for indices in made_of]),
        )

    return replace(dataset, scheme=scheme, faces=tuple(map(converted, dataset.faces)))


def read_datasets(specs: Sequence[str], scheme: str | None = None) -> list[Dataset]:
    """The datasets that several ``FORMAT:PATH`` name, their labels converted to the scheme of a name if one is given.

    Raises:
        InputError: one is named twice, or its labels cannot be converted.
        DatasetError: one cannot be read.
    """
    known: dict[Spec, str] = {}
    for spec in specs:
        parts = parse_spec(spec)
        place = parts._replace(path=real_path(parts.path))
        if place in known:
            raise InputError(f"expected each dataset once; got {known[place]} and {spec}, which are the same")
        known[place] = spec
    datasets = [read_dataset(spec) for spec in specs]
    return datasets if scheme is None else [convert_dataset(dataset, scheme_named(scheme)) for dataset in datasets]


def shared_scheme(datasets: Sequence[Dataset]) -> Scheme:
    """The landmark scheme of all datasets.

    Raises:
        InputError: they have several.
    """
    first = datasets[0]
    for other in datasets[1:]:
        if other.scheme != first.scheme:
            raise InputError(
                f"datasets must share their landmarks: {first.spec} has {first.scheme.name}, {other.spec} has "
                f'{other.scheme.name}; --scheme can convert some that have landmarks, as can scheme = "NAME" in a '
                "configuration"
            )
    return first.scheme
