"""The one record type of all datasets: a face in a picture file, with what is known about it."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxfit.data.names import PathsByEnd
from jaxfit.errors import DatasetError, InputError
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import DEFAULT_ORDER, PoseOrder


@dataclass(frozen=True)
class FaceRecord:
    """One labelled face.

    Attributes:
        image: path of the picture; it need not exist, so that a labelled face without its picture still counts.
        landmarks: (L, 2) float64, x right, y down, pixels, pixel centres at integers; NaN where unknown.
        present: (L,) bool, False where a landmark has no annotation.
        visible: (L,) bool, False where a landmark is hidden; all of ``present`` if the source does not say.
        box: (4,) x, y, width, height in pixels as given by the dataset, or None.
        pose: (3,) roll, pitch, yaw in degrees (pitch > 0 looks up, yaw > 0 turns the nose to image left, roll > 0 is
            clockwise in the image), NaN for an angle that is not known, or None.
        subject: pictures of the same subject are never split between training and testing.
        face: identifies the face within its dataset: file stem, or the dataset's own number.
        pose_order: what the angles of ``pose`` mean; the same head has other angles in another order.
        scale: the length of a pixel in units such as millimetres, or None if unknown.
    """

    image: Path
    landmarks: np.ndarray
    present: np.ndarray
    visible: np.ndarray
    box: np.ndarray | None
    pose: np.ndarray | None
    subject: str
    face: str
    pose_order: PoseOrder = DEFAULT_ORDER
    scale: float | None = None

    @property
    def known(self) -> np.ndarray:
        """(L,) bool: which landmarks are annotated; those that are NaN are not, whatever ``present`` says."""
        return self.present & np.isfinite(self.landmarks).all(1)

    @property
    def complete(self) -> bool:
        """Whether every landmark is annotated; never true of a face that has none."""
        return self.known.size > 0 and bool(self.known.all())


@dataclass(frozen=True)
class Dataset:
    """Faces that share one landmark scheme.

    Attributes:
        spec: how the command line names it, ``FORMAT:PATH``.
        scheme: what the landmarks mean.
        faces: the records, in a fixed order.
        problems: what could not be read, one sentence each: such labels are reported, never silently dropped.
    """

    spec: str
    scheme: Scheme
    faces: tuple[FaceRecord, ...]
    problems: tuple[str, ...] = ()


def check_pictures(source: Path, faces: Sequence[FaceRecord]) -> None:
    """Refuse a dataset that came without its pictures.

    Raises:
        DatasetError: ``faces``, read from ``source``, are some, and the picture of none of them exists.
    """
    if faces and not any(os.path.isfile(face.image) for face in faces):
        raise DatasetError(
            f"{source}: expected pictures of the labelled faces, found none of {len(faces)}, such as "
            f"{faces[0].image}; check the path"
        )


def copies_of(tested: Iterable[Path], pictures: Iterable[Path]) -> dict[Path, Path]:
    """Which ``pictures`` of a dataset are ``tested`` ones, or copies of them, with what each is a copy of.

    A tested picture that is not among them is known by its name: AFLW2000-3D's pictures are AFLW's, cut and scaled,
    under the same names. Of several of its name, the folders' names tell which it is.

    Raises:
        InputError: they do not.
    """
    # A link in a folder is a picture of its own, as in tables.
    tested, pictures = dict.fromkeys(tested), dict.fromkeys(pictures)
    real = {picture: picture.parent.resolve() / picture.name for picture in (*tested, *pictures)}
    places = {real[picture]: picture for picture in pictures}
    by_end = PathsByEnd(map(str, places))
    copies: dict[Path, Path] = {}
    for picture in tested:
        place = real[picture]
        best = [place] if place in places else list(map(Path, by_end.sharing(str(place))))
        if len(best) > 1:
            raise InputError(
                f"{picture} is tested, and may be {best[0]} or {best[1]}, which have its name: expected one picture of "
                "that name, or folders of the same names"
            )
        copies |= {places[candidate]: picture for candidate in best}
    return copies
