"""Drawn heads: pictures of blobs at AFLW's 21 landmarks of the mean head, seen in known poses; how to train on them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxfit.cascade.greedy import Greedy
from jaxfit.data.boxes import bounding_square
from jaxfit.data.pictures import write_image
from jaxfit.heads.model import load_head_model
from jaxfit.image.frame import Frame
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.methods import Options
from jaxfit.learning.train import train
from jaxfit.models.model import Model
from jaxfit.schemes.known import AFLW21

OPTIONS = Options(Greedy((0.6, 0.4)), mirror=False, detectors=False, shape_variance=0.9, frame=Frame(64, 36.0))
SIDE = 140  # pixels, of the pictures
HEAD = np.asarray(load_head_model().of(AFLW21, 0.5).mean)  # cm


def rotation_of(pose: ArrayLike) -> Rotation:
    """The rotation of roll, pitch, yaw in degrees: clockwise, looking up, nose to the image's left."""
    roll, pitch, yaw = np.asarray(pose)
    return Rotation.from_euler("YXZ", [yaw, -pitch, roll], degrees=True)


def draw_head(folder: Path, name: str, pose: ArrayLike, size: float, middle: ArrayLike) -> FaceRecord:
    """Write the picture of a head of ``size`` pixels a cm."""
    points = (size * rotation_of(pose).apply(HEAD))[:, :2] + np.asarray(middle)
    rows, columns = np.mgrid[:SIDE, :SIDE]
    picture = np.full((SIDE, SIDE), 110.0)
    for i, (x, y) in enumerate(points):
        shade = (110 if i % 3 else -90) * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * (2.0 + i % 4) ** 2))
        picture += shade
    write_image(folder / f"{name}.png", np.repeat(picture.clip(0, 255).astype(np.uint8)[..., None], 3, 2))
    seen = np.ones(21, bool)
    return FaceRecord(folder / f"{name}.png", points, seen, seen, None, np.array(pose), name, name)


def draw_heads(folder: Path, count: int) -> tuple[FaceRecord, ...]:
    """Heads in all sorts of poses."""
    rng = np.random.default_rng(0)
    return tuple(
        draw_head(
            folder,
            f"head{number:02}",
            rng.uniform([-10, -15, -30], [10, 15, 30]),
            rng.uniform(4.4, 5.6),
            SIDE / 2 + rng.uniform(-5, 5, 2),
        )
        for number in range(count)
    )


def unlabelled(face: FaceRecord) -> FaceRecord:
    """The face as datasets without landmarks have it: a box and a pose."""
    none = np.zeros(0, bool)
    box = bounding_square(face.landmarks)
    return replace(face, landmarks=np.zeros((0, 2)), present=none, visible=none, box=box)


def train_heads(faces: tuple[FaceRecord, ...], method: str) -> Model:
    """A model of a 3D method."""
    return train(faces, AFLW21, method=method, options=OPTIONS).model
