"""Labels written in the formats of programs for labelling."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np

from jaxfit.data.pictures import picture_size
from jaxfit.data.rows import PIXEL, Row, Rows, rounded
from jaxfit.data.writers.annotations import ANNOTATION_FORMATS, relative_to
from jaxfit.errors import ImageError, InputError
from jaxfit.labels.records import Dataset, FaceRecord

_KEPT = {"box": "boxes", "hidden": "marks of hidden points", "scale": "scales", "subject": "subjects"}


def parse_target(text: str) -> tuple[str, Path]:
    """The format and the path of ``FORMAT:PATH``, or of a path whose ending says the format.

    Raises:
        InputError: there is no such format.
    """
    name, _, path = text.partition(":")
    if name in ANNOTATION_FORMATS and path:
        return name, Path(path)
    # Of several formats of a suffix, the first. A letter and a colon are a drive of Windows.
    for known, format in ANNOTATION_FORMATS.items():
        if format.suffix and Path(text).suffix.lower() == format.suffix and (":" not in text or len(name) == 1):
            return known, Path(text)
    suffixes = dict.fromkeys(format.suffix for format in ANNOTATION_FORMATS.values() if format.suffix)
    raise InputError(
        f"expected FORMAT:PATH with FORMAT one of {', '.join(ANNOTATION_FORMATS)}, or a file that ends in "
        f"{', '.join(suffixes)}; got {text!r}"
    )


def write_labels(dataset: Dataset, format: str, path: Path) -> tuple[int, list[str]]:
    """Write the labels of a dataset to a file, or for ``pts`` into a folder, whole or not at all.

    Pictures are called by their paths from the file's folder.

    Returns:
        How many objects were written, and what the format cannot hold or could not be written, a sentence each.

    Raises:
        InputError: nothing could be written, or the file's folder does not exist.
    """
    writer = ANNOTATION_FORMATS[format]
    faces = sorted(dataset.faces, key=_first_of_picture(dataset))
    problems = list(_lost(faces, writer.keeps, format))
    boxed = "box" in writer.keeps
    empty = [not (face.known.any() or (boxed and face.box is not None)) for face in faces]
    problems += [
        f"{face.image}: {face.face} has no landmarks to write" for face, none in zip(faces, empty, strict=True) if none
    ]
    faces = [face for face, none in zip(faces, empty, strict=True) if not none]
    if format == "pts":
        faces, several = _one_a_picture(faces)
        problems += several
    if not faces:
        raise InputError(f"{path}: expected objects that {format} can hold; there are none: {'; '.join(problems[:3])}")
    listed = list(map(_row, faces))
    rows = Rows(dataset.scheme, None, False, lambda: iter(listed))
    writer.write(path, relative_to(path if format == "pts" else path.parent, rows))
    left_out = dict.fromkeys(rows.failures)
    problems += [f"{image}: {why}" for image, why in left_out]
    return len(faces) - len(rows.failures), problems


def _first_of_picture(dataset: Dataset) -> Callable[[FaceRecord], int]:
    """Where the picture of a face comes first."""
    places: dict[Path, int] = {}
    for face in dataset.faces:
        places.setdefault(face.image, len(places))
    return lambda face: places[face.image]


def _lost(faces: list[FaceRecord], keeps: frozenset[str], format: str) -> Iterator[str]:
    has = {
        "box": [face.box is not None for face in faces],
        "hidden": [bool((face.known & ~face.visible).any()) for face in faces],
        "scale": [face.scale is not None for face in faces],
        "subject": [PurePath(face.subject).name != face.image.stem for face in faces],
    }
    for key, having in has.items():
        if key not in keeps and any(having):
            yield f"{format} does not hold {_KEPT[key]}: those of {sum(having)} objects are left out"
    posed = sum(face.pose is not None for face in faces)
    if posed:
        yield f"{format} does not hold poses: those of {posed} objects are left out"


def _one_a_picture(faces: list[FaceRecord]) -> tuple[list[FaceRecord], list[str]]:
    """The first object of each picture, called like it, as ``.pts`` files are."""
    first: dict[str, FaceRecord] = {}
    problems = []
    for face in faces:
        if first.setdefault(face.image.stem, face) is not face:
            problems.append(f"{face.image}: a .pts file holds one object; {face.face} is left out")
    return [replace(face, face=name) for name, face in first.items()], problems


def _row(face: FaceRecord) -> Row:
    known = face.known
    points = rounded(np.where(known[:, None], face.landmarks, 0.0))
    row: Row = {
        "image": str(face.image),
        "face": face.face,
        # That each picture shows another is what readers think.
        "subject": "" if PurePath(face.subject).name == face.image.stem else face.subject,
        "landmarks": [point if there else [None, None] for point, there in zip(points, known.tolist(), strict=True)],
        "hidden": (known & ~face.visible).tolist(),
        PIXEL: face.scale,
    }
    if face.box is not None:
        row["box"] = dict(zip(("x", "y", "width", "height"), rounded(face.box), strict=True))
    try:
        width, height = picture_size(face.image)
        row["size"] = {"width": width, "height": height}
    except ImageError:
        pass  # formats that need it say so
    return row
