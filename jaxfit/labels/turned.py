"""Labels of pictures that are stored otherwise than they are seen: turned or mirrored, as their EXIF data say.

Everything in jaxfit sees pictures as people do, and labels belong to that. Labels that were made on the stored pixels,
by a program that did not look at EXIF, are turned with their pictures when they are read.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxfit.data.headers import has_jpeg_header
from jaxfit.data.inputs import open_regular
from jaxfit.data.limits import most_picture_bytes
from jaxfit.data.orientations import SIDEWAYS, orientation_of
from jaxfit.data.pictures import read_grey
from jaxfit.errors import ImageError, InputError
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.schemes.scheme import Scheme

_HEAD = 1 << 16  # bytes of a picture that are read first: most JPEG files say by then how they are turned
_MIRRORED = (2, 4, 5, 7)
_NAMED = 3  # pictures that a notice names


def turned_pictures(pictures: Iterable[Path]) -> dict[Path, int]:
    """Those of some pictures that are not seen as they are stored, with their EXIF orientations, from 2 to 8."""
    turned = {}
    for picture in dict.fromkeys(pictures):
        try:
            with open_regular(picture, most_picture_bytes()) as file:
                head = file.read(_HEAD)
                orientation = orientation_of(head if has_jpeg_header(head) else head + file.read())
        except (OSError, ValueError):  # whoever needs the picture says so
            continue
        if orientation != 1:
            turned[picture] = orientation
    return turned


def noticed(dataset: Dataset, spec: str, stored: str) -> Dataset:
    """The dataset, with a notice in its problems if its pictures are not all seen as they are stored.

    Args:
        dataset: whose labels belong to pictures as they are seen.
        spec: its name.
        stored: its name if they belonged to the stored pixels.
    """
    turned = turned_pictures(face.image for face in dataset.faces)
    if not turned:
        return dataset
    notice = (
        f"{spec}: {_named(turned)}: seen otherwise than stored, as the files say; labels are taken for those of the "
        f"pictures as they are seen; if they belong to the pixels as they are stored, say {stored}"
    )
    return replace(dataset, problems=(*dataset.problems, notice))


def _named(turned: Mapping[Path, int]) -> str:
    some = [f"{path} (orientation {orientation})" for path, orientation in list(turned.items())[:_NAMED]]
    left = len(turned) - len(some)
    return f"{', '.join(some)}{f' and {left} more' if left else ''}"


def as_seen(dataset: Dataset) -> Dataset:
    """A dataset whose labels belong to the stored pixels, with labels of the pictures as they are seen.

    Poses of pictures that are turned are left out. Faces whose labels cannot be turned become problems.
    """
    turned = turned_pictures(face.image for face in dataset.faces)
    faces, problems = [], list(dataset.problems)
    for face in dataset.faces:
        try:
            orientation = turned.get(face.image, 1)
            faces.append(face if orientation == 1 else _seen(face, orientation, dataset.scheme))
        except ImageError as error:
            problems.append(str(error))
        except InputError as error:
            problems.append(f"{face.image}: {error}")
    return replace(dataset, faces=tuple(faces), problems=tuple(problems))


def _seen(face: FaceRecord, orientation: int, scheme: Scheme) -> FaceRecord:
    height, width = read_grey(face.image).shape
    size = (height, width) if orientation in SIDEWAYS else (width, height)
    order = np.arange(scheme.count)
    if orientation in _MIRRORED:  # what was labelled as the right eye is seen as the left one
        if scheme.mirror is None and scheme.count:
            raise InputError(
                f"it is mirrored, and which landmarks of {scheme.name} are mirror images of each other is not known"
            )
        order = np.array(scheme.mirror or (), int)
    box = None
    if face.box is not None:
        corners = seen_points(np.array([face.box[:2], face.box[:2] + face.box[2:]]), size, orientation)
        box = np.concatenate([corners.min(0), np.ptp(corners, 0)])
    return replace(
        face,
        landmarks=seen_points(face.landmarks, size, orientation)[order],
        present=face.present[order],
        visible=face.visible[order],
        box=box,
        pose=None,
    )


def seen_points(points: np.ndarray, size: tuple[int, int], orientation: int) -> np.ndarray:
    """Where points (N, 2) of the stored pixels are seen.

    Args:
        points: x and y, pixel centres at integers.
        size: stored width and height.
        orientation: of EXIF, from 1 to 8.
    """
    (x, y), (right, bottom) = points.T, (size[0] - 1, size[1] - 1)
    places = {
        1: (x, y),
        2: (right - x, y),
        3: (right - x, bottom - y),
        4: (x, bottom - y),
        5: (y, x),
        6: (bottom - y, x),
        7: (bottom - y, right - x),
        8: (y, right - x),
    }
    return np.stack(places[orientation], axis=1)
