"""The formats of labelled faces by the names that the command line uses, ``FORMAT:PATH``; conversion of labels."""

import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.data.inputs import read_text
from jaxfit.data.names import real_path
from jaxfit.errors import InputError
from jaxfit.labels.importers.aflw import read_aflw
from jaxfit.labels.importers.aflw2000 import read_aflw2000, read_aflw2000_again
from jaxfit.labels.importers.coco import read_coco
from jaxfit.labels.importers.csv_points import read_csv_points, read_ml_morph
from jaxfit.labels.importers.imglab import read_imglab
from jaxfit.labels.importers.lfpw import read_lfpw
from jaxfit.labels.importers.pointing04 import read_pointing04
from jaxfit.labels.importers.pts_folder import read_pts_folder
from jaxfit.labels.importers.tps import read_tps
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.labels.turned import as_seen, noticed
from jaxfit.schemes.conversions import convert, described, sources
from jaxfit.schemes.known import scheme_named
from jaxfit.schemes.own import OwnScheme, own_scheme
from jaxfit.schemes.scheme import Scheme

_MOST_BYTES = 1 << 20  # of a scheme's file

# A reader gets the path and returns the labelled faces, at least one of them with its picture, or raises DatasetError.
FORMATS: dict[str, Callable[[Path], Dataset]] = {
    "pts": read_pts_folder,
    "pts0": partial(read_pts_folder, base=0),
    "aflw": read_aflw,
    "lfpw": read_lfpw,
    "pointing04": read_pointing04,
    "aflw2000": read_aflw2000,
    "aflw2000-all": partial(read_aflw2000, most_degrees=math.inf),
    "aflw2000-re": read_aflw2000_again,
    "tps": read_tps,
    "imglab": read_imglab,
    "coco": read_coco,
    "csv": read_csv_points,
    "ml-morph": read_ml_morph,
}
# In these, y counts from the bottom: readers have to know of which pixels.
FROM_BOTTOM: dict[str, Callable[..., Dataset]] = {"tps": read_tps, "ml-morph": read_ml_morph}
# Files that need no FORMAT before them: how their names end says it.
_SUFFIXES = {".tps": "tps", ".xml": "imglab", ".json": "coco", ".csv": "csv"}


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
    """The parts of ``FORMAT:PATH``, ``FORMAT+PIXELS:PATH``, ``FORMAT@stored:PATH`` or ``FORMAT@stored+PIXELS:PATH``, or
    of the path alone of a file whose name says its format.

    Raises:
        InputError: no path, or an unknown format.
    """
    name, _, path = spec.partition(":")
    known = re.fullmatch(r"(.+?)(@stored)?([+-][0-9]*\.?[0-9]+)?", name)
    if not known or known[1] not in FORMATS or not path:
        # A letter and a colon are a drive of Windows; a longer word is a format that does not exist.
        of_suffix = _SUFFIXES.get(Path(spec).suffix.lower())
        if of_suffix and (":" not in spec or len(name) == 1 or Path(spec).exists()):
            return Spec(of_suffix, 0.0, spec, False)
        raise InputError(
            f"expected a dataset as FORMAT:PATH with FORMAT one of {', '.join(FORMATS)}, or a file that ends in "
            f"{', '.join(_SUFFIXES)}; got {spec!r}{_meant(spec)}"
        )
    return Spec(known[1], float(known[3] or 0), path, known[2] is not None)


def _meant(spec: str) -> str:
    """What somebody may have meant by a dataset without a format, as the end of a sentence."""
    path = Path(spec)
    if path.is_dir():
        return f", a folder: if it has .pts files, give pts:{spec}"
    return "" if ":" in spec or path.exists() else ", and there is no such file or folder"


def read_dataset(spec: str) -> Dataset:
    """The dataset that ``spec``, ``FORMAT:PATH``, names.

    ``FORMAT+PIXELS:PATH`` moves the labels right and down by that many pixels when they are read,
    ``FORMAT-PIXELS:PATH``
    left and up, so that datasets whose labels count pixels differently can be used together. Labels belong to upright
    pictures, which EXIF data may have turned; those of ``FORMAT@stored:PATH`` belong to the pixels as they are stored,
    and are turned with their pictures. A problem names the pictures for which this matters.

    Raises:
        InputError: no path, or an unknown format.
        DatasetError: the dataset is missing, damaged, or has no face that can be used.
    """
    name, shift, path, stored = parse_spec(spec)
    read = partial(FROM_BOTTOM[name], stored=True) if stored and name in FROM_BOTTOM else FORMATS[name]
    found = read(Path(path))
    moved = tuple(replace(face, landmarks=face.landmarks + shift) for face in found.faces) if shift else found.faces
    dataset = replace(found, faces=moved, spec=spec)
    shifted = f"{shift:+g}" if shift else ""
    return as_seen(dataset) if stored else noticed(dataset, spec, f"{name}@stored{shifted}:{path}")


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


def read_datasets(specs: Sequence[str], scheme: str | Mapping[str, Any] | None = None) -> list[Dataset]:
    """The datasets that several ``FORMAT:PATH`` name, their labels converted to a scheme if one is given: by its name,
    or as a scheme of one's own, as `scheme_values` reads it.

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
    if scheme is None:
        return datasets
    given = given_scheme(scheme)
    return [given.of(dataset) for dataset in datasets]


class GivenScheme(NamedTuple):
    """What ``--scheme`` says.

    Attributes:
        known: a known scheme, or N points.
        own: one of one's own; one of both is None.
    """

    known: Scheme | None
    own: OwnScheme | None

    def of(self, dataset: Dataset) -> Dataset:
        """The dataset with its labels converted to the scheme, and with its scale, where pictures have none.

        Raises:
            InputError: they cannot be converted.
        """
        if self.own is None:
            assert self.known is not None
            return convert_dataset(dataset, self.known)
        try:
            converted = convert_dataset(dataset, self.own.of(dataset.scheme))
        except InputError as error:
            prefix = "" if str(error).startswith(dataset.spec) else f"{dataset.spec}: "
            raise InputError(f"{prefix}{error}") from None
        if self.own.scale is None:
            return converted
        faces = (face if face.scale else replace(face, scale=self.own.scale) for face in converted.faces)
        return replace(converted, faces=tuple(faces))


def given_scheme(scheme: str | Mapping[str, Any]) -> GivenScheme:
    """The scheme that `scheme_values` names."""
    values = scheme_values(scheme)
    return GivenScheme(scheme_named(values), None) if isinstance(values, str) else GivenScheme(None, own_scheme(values))


def scheme_values(scheme: str | Mapping[str, Any]) -> str | dict[str, Any]:
    """The name of a known scheme, or of N points, ``pointsN``; or the table of one of one's own, which comes as such,
    as a TOML file, or as text in braces, such as ``{mirror = [[1, 4]], lines = [[1, 2, 3]]}``.

    `jaxfit.schemes.own.own_scheme` says what a table may hold; a file's scheme is called like the file unless it has a
    name.

    Raises:
        InputError: there is no such scheme or file, or it says something else.
    """
    if not isinstance(scheme, str):
        own_scheme(scheme)
        return dict(scheme)
    inline = scheme.lstrip().startswith("{")
    if not inline and Path(scheme).suffix.lower() != ".toml":
        return scheme_named(scheme).name
    try:
        if inline:
            values = tomllib.loads(f"scheme = {scheme.strip()}")["scheme"]
        else:
            values = {"name": Path(scheme).stem} | tomllib.loads(read_text(scheme, _MOST_BYTES))
        own_scheme(values)
    except OSError as error:
        raise InputError(f"{scheme}: cannot be read ({error.strerror or error}); expected a scheme in TOML") from None
    except InputError as error:
        raise InputError(f"{scheme}: {error}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{scheme}: expected a scheme in TOML; {error}") from None
    return values


def shared_scheme(datasets: Sequence[Dataset]) -> Scheme:
    """The landmark scheme of all datasets.

    Raises:
        InputError: they have several.
    """
    first = datasets[0]
    for other in datasets[1:]:
        if other.scheme != first.scheme:
            raise InputError(
                f"datasets must share their landmarks: {first.spec} has {described(first.scheme)}, {other.spec} has "
                f"{described(other.scheme)}; --scheme can convert some that have landmarks, as can "
                'scheme = "NAME" in a configuration'
            )
    return first.scheme
