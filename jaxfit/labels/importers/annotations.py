"""What files of annotations have in common: entries of a picture each, made into the records of one dataset."""

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np

from jaxfit.data.inputs import read_text
from jaxfit.data.names import plain
from jaxfit.data.numbers import number
from jaxfit.data.orientations import SIDEWAYS
from jaxfit.data.pictures import picture_size
from jaxfit.errors import DatasetError, ImageError, InputError
from jaxfit.labels.records import Dataset, FaceRecord, check_pictures
from jaxfit.labels.turned import turned_pictures
from jaxfit.schemes.known import scheme_named
from jaxfit.schemes.own import numbered
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import DEFAULT_ORDER, PoseOrder

MOST_BYTES = 1 << 30  # of a file of annotations: some hundred thousand objects
_MISSING = ("", "na", "nan", "none", "null")


@dataclass(frozen=True)
class Annotation:
    """One labelled object, as a file has it.

    Attributes:
        where: file and place in it, for messages.
        image: what the file calls the picture.
        landmarks: (L, 2) pixels, NaN where missing.
        face: what the file calls the object; empty if it does not.
        visible: (L,) bool, or None if the file does not say.
        box: (4,), or None.
        scale: the length of a pixel in units, or None.
        subject: who or what is in the picture; empty if the file does not say: each picture shows another.
        pose: (3,) roll, pitch and yaw in degrees, NaN for an angle that is missing, or None.
        pose_order: what the angles mean, as in ``FaceRecord``.
    """

    where: str
    image: str
    landmarks: np.ndarray
    face: str = ""
    visible: np.ndarray | None = None
    box: np.ndarray | None = None
    scale: float | None = None
    subject: str = ""
    pose: np.ndarray | None = None
    pose_order: PoseOrder = DEFAULT_ORDER


def coordinate(text: str) -> float:
    """A number; NaN where the text says that it is missing.

    Raises:
        ValueError: it is neither, or not finite.
    """
    if text.strip().lower() in _MISSING:
        return float("nan")
    value = number(text)
    if not np.isfinite(value):
        raise ValueError(f"expected a finite number; got {text!r}")
    return value


def given_scale(value: float | None, where: str, problems: list[str]) -> float | None:
    """A scale, if it is one; else None and a problem."""
    if value is None or np.isnan(value):
        return None
    if not (np.isfinite(value) and value > 0):
        problems.append(f"{where}: expected a scale above 0; got {value:g}: it is left out")
        return None
    return float(value)


def named_scheme(file: Path, names: Sequence[str]) -> Scheme:
    """The scheme of points that a file names; of points that it only numbers, names are none.

    Raises:
        DatasetError: they cannot be names.
    """
    try:
        return Scheme(f"points{len(names)}", len(names), names=() if numbered(names) else tuple(names))
    except InputError as error:
        raise DatasetError(f"{file}: {error}") from None


def annotation_text(file: Path, kind: str) -> str:
    """The text of a file of annotations.

    Raises:
        DatasetError: it is missing, too large or not UTF-8.
    """
    try:
        return read_text(file, MOST_BYTES)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise DatasetError(f"{file}: expected {kind}; {why}") from error


class PicturesBeside:
    """Finds the pictures that a file of annotations names.

    A name is a path from the file's folder, or from the working folder; or a file of this name lies beside the file, or
    in a folder beside it: programs that label write paths of other machines.
    """

    def __init__(self, file: Path):
        self._folder = file.parent
        self._found: dict[str, Path] = {}
        self._spelled: dict[Path, dict[str, Path]] = {}

    def path_of(self, name: str) -> Path:
        """Where the picture is; where it should be, if it is nowhere.

        Raises:
            DatasetError: there are several.
        """
        if name not in self._found:
            self._found[name] = self._path_of(name)
        return self._found[name]

    def _path_of(self, name: str) -> Path:
        last = PurePosixPath(name.replace("\\", "/")).name
        for path in (self._folder / name, Path(name), self._folder / last):
            if last and os.path.isfile(path):
                return path
        within = [folder / last for folder in self._folders if last and os.path.isfile(folder / last)]
        if len(within) > 1:
            raise DatasetError(f"{name} may be {within[0]} or {within[1]}; give its path from {self._folder}")
        if within:
            return within[0]
        # Names that are no text are spelled otherwise in files.
        for folder in dict.fromkeys([(self._folder / name).parent, self._folder]):
            for spelled in dict.fromkeys([PurePosixPath(name).name, last]):
                if found := self._by_spelling(folder).get(spelled):
                    return found
        return self._folder / name

    @cached_property
    def _folders(self) -> tuple[Path, ...]:
        """The folders beside the file."""
        try:
            return tuple(sorted(path for path in self._folder.iterdir() if path.is_dir()))
        except OSError:
            return ()

    def _by_spelling(self, folder: Path) -> dict[str, Path]:
        """The files of a folder that are spelled otherwise than they are called."""
        if folder not in self._spelled:
            try:
                names = os.listdir(folder)
            except (OSError, ValueError):
                names = []
            self._spelled[folder] = {spelled: folder / name for name in names if (spelled := plain(name)) != name}
        return self._spelled[folder]


def dataset_of(
    spec: str,
    file: Path,
    annotations: Sequence[Annotation],
    problems: Iterable[str],
    *,
    scheme: Scheme | None = None,
    from_bottom: bool = False,
    stored: bool = False,
) -> Dataset:
    """The dataset of a file's annotations.

    All objects have the number of points that most have; others become problems, and so do objects without a point and
    a box.

    Args:
        spec: how the command line names it.
        file: that was read.
        annotations: what is in it.
        problems: what could not be read.
        scheme: what the landmarks mean, if the file says that.
        from_bottom: whether y counts rows from the bottom of the picture, as in TPS files: the row is height - y.
        stored: whether it counts those of the pixels as they are stored, whatever EXIF data say.

    Raises:
        DatasetError: nothing can be used, or no picture is there.
    """
    problems = list(problems)
    counts = Counter(len(each.landmarks) for each in annotations)
    if not counts:
        first = f"first problem: {problems[0]}" if problems else "it has none"
        raise DatasetError(f"{file}: expected labelled objects; {first}")
    count = scheme.count if scheme else counts.most_common(1)[0][0]
    pictures = PicturesBeside(file)
    faces: list[FaceRecord] = []
    names = _unique([each.face for each in annotations], [each.image for each in annotations])
    for each, name in zip(annotations, names, strict=True):
        if len(each.landmarks) != count:
            problems.append(f"{each.where}: has {len(each.landmarks)} points, most others have {count}")
            continue
        known = np.isfinite(each.landmarks)
        present = known.all(1)
        if (known.any(1) & ~present).any():
            problems.append(f"{each.where}: expected both numbers of a point, or none; got one")
            continue
        if not present.any() and each.box is None and each.pose is None:
            problems.append(f"{each.where}: has no point that is not missing, and no box")
            continue
        try:
            image = pictures.path_of(each.image)
        except DatasetError as error:
            problems.append(f"{each.where}: {error}")
            continue
        faces.append(
            FaceRecord(
                image=image,
                landmarks=np.where(present[:, None], each.landmarks, np.nan),
                present=present,
                visible=present.copy() if each.visible is None else each.visible & present,
                box=each.box,
                pose=each.pose,
                pose_order=each.pose_order,
                subject=each.subject or _without_suffix(each.image),
                face=name,
                scale=each.scale,
            )
        )
    if not faces:
        raise DatasetError(f"{file}: expected labelled objects; first problem: {problems[0]}")
    check_pictures(file, faces)
    if from_bottom:
        faces, unflipped = _flipped(faces, stored)
        problems += [f"{file}: {problem}" for problem in unflipped]
        if not faces:
            raise DatasetError(f"{file}: expected pictures that can be read; first problem: {problems[0]}")
    return Dataset(spec, scheme or scheme_named(f"points{count}"), tuple(faces), tuple(problems))


def _flipped(faces: Sequence[FaceRecord], stored: bool) -> tuple[list[FaceRecord], list[str]]:
    """Faces whose y counts from the bottom of their pictures, with y that counts from the top."""
    turned = turned_pictures(face.image for face in faces) if stored else {}
    heights: dict[Path, int | str] = {}
    flipped: list[FaceRecord] = []
    problems: list[str] = []
    for face in faces:
        if face.image not in heights:
            try:
                width, height = picture_size(face.image)
                heights[face.image] = width if turned.get(face.image) in SIDEWAYS else height
            except ImageError as error:
                heights[face.image] = f"{error}: without its height, from which y counts, its labels are left out"
        known = heights[face.image]
        if isinstance(known, str):
            problems.append(known)
        else:
            flipped.append(replace(face, landmarks=upside_down(face.landmarks, known)))
    return flipped, list(dict.fromkeys(problems))


def upside_down(landmarks: np.ndarray, height: int) -> np.ndarray:
    """Landmarks (L, 2) with y from the other end of a picture: the row is height - y, and y is height - row."""
    return np.stack([landmarks[:, 0], height - landmarks[:, 1]], axis=1)


def _without_suffix(image: str) -> str:
    path = PurePosixPath(image.replace("\\", "/"))
    return path.with_suffix("").as_posix() if path.name else image


def _unique(names: Sequence[str], images: Sequence[str]) -> list[str]:
    """What objects are called: as the file has it, if that tells them apart; else after their pictures."""
    if all(names) and len({*names}) == len(names):
        return list(names)
    stems = [PurePosixPath(_without_suffix(image)).name for image in images]
    several, numbers = Counter(stems), Counter[str]()
    unique = []
    for stem in stems:
        numbers[stem] += 1
        unique.append(f"{stem}_{numbers[stem]}" if several[stem] > 1 else stem)
    return unique
