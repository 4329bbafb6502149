"""The one record type of all datasets: a face in a picture file, with what is known about it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxfit.shapes.schemes import Scheme


@dataclass(frozen=True)
class FaceRecord:
    """One labelled face.

    Attributes:
        image: path of the picture.
        landmarks: (L, 2) float64, x right, y down, pixels, pixel centres at integers; NaN where unknown.
        present: (L,) bool, False where a landmark has no annotation.
        visible: (L,) bool, False where a landmark is hidden; all of ``present`` if the source does not say.
        box: (4,) x, y, width, height in pixels as given by the dataset, or None.
        pose: (3,) roll, pitch, yaw in degrees (pitch > 0 looks up, yaw > 0 turns the nose to image left), or None.
        subject: pictures of the same subject are never split between training and testing.
        face: identifies the face within its dataset: file stem, or the dataset's own number.
    """

    image: Path
    landmarks: np.ndarray
    present: np.ndarray
    visible: np.ndarray
    box: np.ndarray | None
    pose: np.ndarray | None
    subject: str
    face: str

    @property
    def complete(self) -> bool:
        """Whether every landmark is annotated."""
        return bool(self.present.all())


@dataclass(frozen=True)
class Dataset:
    """Faces that share one landmark scheme.

    Attributes:
        spec: how the command line names it, ``FORMAT:PATH``.
        scheme: what the landmarks mean.
        faces: the records, in a fixed order.
        problems: what could not be read, one sentence each: such pictures are reported, never silently dropped.
    """

    spec: str
    scheme: Scheme
    faces: tuple[FaceRecord, ...]
    problems: tuple[str, ...] = ()
