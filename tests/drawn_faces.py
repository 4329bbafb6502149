"""Drawn faces: pictures with five blobs where the landmarks are, and how to train on them in seconds."""

from pathlib import Path

import numpy as np

from jaxfit.cascade.greedy import Greedy
from jaxfit.data.pictures import write_image
from jaxfit.data.pts import write_pts
from jaxfit.image.frame import Frame
from jaxfit.learning.methods import Options

OPTIONS = Options(Greedy((0.6, 0.4), 6), mirror=False, frame=Frame(64, 36.0))
TRAIN = ["--windows", "0.6", "0.4", "--augmentations", "6", "--crop", "64", "--face", "36", "--no-mirror"]
TRAIN += ["--descriptor", "sift", "--spread", "1", "--copies", "0", "--folds", "0"]  # the same
POINTS = np.array([[-20.0, -15.0], [20.0, -15.0], [0.0, 5.0], [-14.0, 22.0], [14.0, 22.0]])


def draw_face(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A (120, 120, 3) picture with five blobs of different sizes, and where they are."""
    points = 60 + rng.uniform(0.8, 1.2) * POINTS + rng.uniform(-8, 8, 2) + rng.normal(0, 1, POINTS.shape)
    rows, columns = np.mgrid[:120, :120]
    picture = np.full((120, 120), 60.0)
    for i, (x, y) in enumerate(points):
        picture += (150 - 20 * i) * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * (2.5 + i) ** 2))
    picture += rng.normal(0, 2, picture.shape)
    return np.repeat(np.clip(picture, 0, 255).astype(np.uint8)[..., None], 3, 2), points


def draw_faces(folder: Path, count: int) -> Path:
    """The folder, with drawn faces and their ``.pts`` labels written into it."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    for number in range(count):
        picture, points = draw_face(rng)
        write_image(folder / f"face{number:03}.png", picture)
        write_pts(folder / f"face{number:03}.pts", points)
    return folder
