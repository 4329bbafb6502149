"""Fits that other programs made, in files: read, and matched with labelled faces by where they are."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxfit.data.boxes import UNKNOWN_BOX
from jaxfit.data.detectors.detector import overlap
from jaxfit.data.names import pictures_named
from jaxfit.errors import DatasetError, InputError
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.labels.importers.annotations import Annotation
from jaxfit.labels.importers.coco import coco_annotations
from jaxfit.labels.importers.csv_points import csv_annotations
from jaxfit.labels.importers.json_lines import json_lines_annotations
from jaxfit.labels.importers.pts_folder import picture_stem, read_all_pts
from jaxfit.labels.records import FaceRecord
from jaxfit.schemes.conversions import convert
from jaxfit.schemes.known import NO_LANDMARKS, scheme_of_count, scheme_of_numbered
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import DEFAULT_ORDER
from jaxfit.shapes.pose_order import in_order

LEAST_OVERLAP = 0.2  # of the box of a fit with that of a labelled face (IoU), from which it may be a fit of it

_Read = Callable[[Path], tuple[Scheme, list[Annotation], list[str]]]


def _read_pts(folder: Path, base: int = 1) -> tuple[Scheme, list[Annotation], list[str]]:
    found, problems = read_all_pts(sorted(path for path in folder.iterdir() if path.suffix.lower() == ".pts"), base)
    faces = [Annotation(str(path), path.stem, landmarks, face=path.stem) for path, landmarks in found.items()]
    count = max((len(each.landmarks) for each in faces), default=0)
    return scheme_of_count(count) if count else NO_LANDMARKS, faces, problems


# By the names that come before a path, as in ``pts0:fits``.
FIT_FORMATS: dict[str, _Read] = {
    "csv": csv_annotations,
    "jsonl": json_lines_annotations,
    "coco": coco_annotations,
    "pts": _read_pts,
    "pts0": lambda folder: _read_pts(folder, base=0),
}
_FOLDERS = ("pts", "pts0")  # their files are called like the pictures, but for what their names end with
_SUFFIXES = {".csv": "csv", ".jsonl": "jsonl", ".json": "coco"}


@dataclass(frozen=True)
class FoundFaces:
    """Faces that some program found, wherever their pictures are.

    Attributes:
        path: of the file, or the folder.
        scheme: what their landmarks mean; `NO_LANDMARKS` if there are only poses.
        faces: what was found, in the order of the file.
        by_stem: whether pictures are named without their suffixes.
        problems: what could not be read, a sentence each.
    """

    path: Path
    scheme: Scheme
    faces: tuple[Annotation, ...]
    by_stem: bool
    problems: tuple[str, ...]

    @property
    def posed(self) -> bool:
        """Whether there are poses."""
        return any(face.pose is not None for face in self.faces)


def fits_format(spec: str) -> tuple[str, Path] | None:
    """The format and the path of a file of fits; None if it is no such file by its name.

    Args:
        spec: a path, or ``FORMAT:PATH`` with one of ``FIT_FORMATS``.
    """
    name, _, path = spec.partition(":")
    if path and name in FIT_FORMATS:
        return name, Path(path)
    if Path(spec).is_dir():
        return "pts", Path(spec)
    known = _SUFFIXES.get(Path(spec).suffix.lower())
    return None if known is None else (known, Path(spec))


def read_fits(spec: str) -> FoundFaces:
    """Fits that some program wrote: CSV (a row a face), JSON lines, COCO's keypoints, or a folder of ``.pts``.

    Tables have the columns that ``landmarks.csv`` and ``heads.csv`` have, or some of them: ``image``; landmarks, a box
    or a pose. Points that are only numbered belong to the known scheme with as many points, if there is one.

    Args:
        spec: as in `fits_format`.

    Raises:
        InputError: the name says no format.
        DatasetError: it cannot be read, or there are no faces in it.
    """
    known = fits_format(spec)
    if known is None:
        raise InputError(
            f"expected a file of fits as FORMAT:PATH, with FORMAT one of {', '.join(FIT_FORMATS)}, or a path that ends "
            f"in {', '.join(_SUFFIXES)}, or a folder of .pts; got {spec!r}"
        )
    name, path = known
    if name in _FOLDERS and not path.is_dir():
        raise DatasetError(f"{path}: expected a folder of .pts files, found none; check the path")
    scheme, faces, problems = FIT_FORMATS[name](path)
    scheme = scheme_of_numbered(scheme)
    kept = []
    for face in faces:
        if len(face.landmarks) not in (0, scheme.count):
            problems.append(f"{face.where}: has {len(face.landmarks)} points, others have {scheme.count}")
        else:
            kept.append(face)
    if not kept:
        reason = f"; first problem: {problems[0]}" if problems else ""
        raise DatasetError(f"{path}: expected fits of faces; found none{reason}")
    return FoundFaces(path, scheme, tuple(kept), name in _FOLDERS, tuple(problems))


def faces_in_pictures(
    found: FoundFaces, pictures: Iterable[Path], folders: Iterable[str | Path] = ()
) -> tuple[dict[Path, list[Annotation]], list[str]]:
    """The found faces of each picture, and the names in the file that no picture has.

    Args:
        found: the faces.
        pictures: that may be meant.
        folders: that paths in the file may be relative to, besides that of the file.

    Raises:
        InputError: a name may mean several pictures.
    """
    pictures = list(dict.fromkeys(pictures))
    names = list(dict.fromkeys(face.image for face in found.faces))
    try:
        if found.by_stem:
            meant = _by_stem(names, pictures)
        else:
            meant = pictures_named(names, pictures, [found.path.parent, *folders])
    except InputError as error:
        raise InputError(f"{found.path}: {error}") from None
    of_pictures: dict[Path, list[Annotation]] = {}
    for face in found.faces:
        for picture in meant.get(face.image, ()):
            of_pictures.setdefault(picture, []).append(face)
    return of_pictures, [name for name in names if name not in meant]


def _by_stem(names: Sequence[str], pictures: Sequence[Path]) -> dict[str, list[Path]]:
    stems: dict[str, list[Path]] = {}
    for picture in pictures:
        stems.setdefault(picture.stem, []).append(picture)
    meant = {}
    for name in names:
        some = stems.get(name) or stems.get(picture_stem(Path(name)), [])
        if len(some) > 1:
            raise InputError(
                f"{name!r} may mean {some[0]} or {some[1]}; expected a name of one picture: a table with their paths"
            )
        if some:
            meant[name] = some
    return meant


def match_faces(
    faces: Sequence[FaceRecord], of_pictures: Mapping[Path, list[Annotation]], source: Scheme, scheme: Scheme
) -> list[Annotation | None]:
    """Which found face each of N labelled faces is; each is one labelled face at most.

    Faces of a picture are matched by their boxes, those that overlap most first, and by at least ``LEAST_OVERLAP``.
    The boxes are those around the landmarks that both have; without landmarks, those that the file or the dataset says;
    where one of them says none, a face is only matched if it is the only one of its picture on both sides.

    Args:
        faces: N labelled faces.
        of_pictures: the found faces of each picture, in any order.
        source: what their landmarks mean.
        scheme: what the labels mean.
    """
    matched: list[Annotation | None] = [None] * len(faces)
    numbers_of: dict[Path, list[int]] = {}
    for number, face in enumerate(faces):
        numbers_of.setdefault(face.image, []).append(number)
    for picture, numbers in numbers_of.items():
        found = of_pictures.get(picture, [])
        boxes = [box_around(_converted(each, source, scheme), each.box) for each in found]
        true = [box_around(faces[number].landmarks, faces[number].box) for number in numbers]
        if len(found) == len(numbers) == 1 and np.isnan([*boxes, *true]).any():
            matched[numbers[0]] = found[0]
            continue
        pairs = [
            (-shared, number, tuple(box), k)
            for number, of_face in zip(numbers, true, strict=True)
            for k, box in enumerate(boxes)
            if (shared := overlap(of_face, box)) >= LEAST_OVERLAP  # not where one of them is NaN
        ]
        used: set[int] = set()
        for _, number, _, k in sorted(pairs):  # whatever the order in the file
            if matched[number] is None and k not in used:
                matched[number] = found[k]
                used.add(k)
    return matched


def _converted(face: Annotation, source: Scheme, scheme: Scheme) -> np.ndarray:
    return convert(face.landmarks, source, scheme) if len(face.landmarks) else face.landmarks


def box_around(landmarks: np.ndarray, box: np.ndarray | None) -> np.ndarray:
    """The rectangle (4,) around the points (L, 2) that are known; without any, the box; without that, NaN."""
    known = landmarks[np.isfinite(landmarks).all(1)]
    if len(known):
        return np.concatenate([known.min(0), np.ptp(known, 0)])
    return UNKNOWN_BOX if box is None else box


def fits_of_matched(
    matched: Sequence[Annotation | None], faces: Sequence[FaceRecord], source: Scheme, scheme: Scheme, posed: bool
) -> Fits:
    """The found faces as fits of labelled ones, a row each, whose landmarks mean what ``scheme`` says.

    Args:
        matched: N found faces, as `match_faces` gives them.
        faces: the N labelled faces.
        source: what the found landmarks mean.
        scheme: what they are converted to.
        posed: whether the fits have poses.
    """
    landmarks, boxes = np.full((len(faces), scheme.count, 2), np.nan), np.full((len(faces), 4), np.nan)
    poses = np.full((len(faces), 3), np.nan)
    for row, face in enumerate(matched):
        if face is not None:
            boxes[row] = UNKNOWN_BOX if face.box is None else face.box
            poses[row] = np.nan if face.pose is None else face.pose
            if len(face.landmarks):
                landmarks[row] = _converted(face, source, scheme)
    given = [DEFAULT_ORDER if face is None else face.pose_order for face in matched]
    return Fits(
        scheme=scheme,
        names=tuple(str(face.image) for face in faces),
        sizes=np.zeros((len(faces), 2), int),
        pictures=np.arange(len(faces)),
        boxes=boxes,
        kinds=("",) * len(faces),
        rotations=np.zeros(len(faces)),
        landmarks=landmarks,
        problems=tuple(
            Problem(row, str(faces[row].image), "there is no fit of this face", row)
            for row, face in enumerate(matched)
            if face is None
        ),
        pose=in_order(poses, [DEFAULT_ORDER] * len(faces), given) if posed else None,
    )
