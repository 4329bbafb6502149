"""A tiny world to train in: faces of four bright blobs on dark noise, in crops of 48 pixels."""

from dataclasses import dataclass

import numpy as np
from jax import numpy as jnp
from scipy import ndimage

from jaxfit.cascade.greedy import TrainingSet
from jaxfit.cascade.starts import Spread
from jaxfit.image.frame import Frame
from jaxfit.image.sampling import bilinear, pack
from jaxfit.image.smoothing import smooth
from jaxfit.shapes.points import PointSpace
from jaxfit.shapes.similarity import learn_similarity_asm
from jaxfit.shapes.space import rotate

FRAME = Frame(crop=48, face=24.0)
MEAN = np.array([[-12, -12], [12, -12], [-8, 12], [8, 12]], np.float32)
SPACE = PointSpace(jnp.asarray(MEAN))
SPREAD = Spread(shift=(0.08, 0.08), log_scale=0.05, rotation=0.1)


@dataclass(frozen=True)
class Patch:
    """The picture itself at a few points around the landmark: a descriptor that compiles fast."""

    turns: bool = False
    samples: int = 3
    levels = 1
    frame = FRAME

    @property
    def size(self):
        return self.samples**2

    def level(self, window):
        return jnp.zeros((), jnp.int32)

    def prepare(self, crop):
        return pack(smooth(crop.astype(jnp.float32)) / 255)

    def aim(self, prepared, level, point, side, angle):
        line = side * jnp.linspace(-0.5, 0.5, self.samples)
        grid = jnp.stack(jnp.meshgrid(line, line), -1).reshape(-1, 2)
        return rotate(grid, angle * self.turns) + point

    def describe(self, prepared, level, aim, angle):
        return bilinear(prepared, *aim.T)[:, None]

    def normalise(self, histograms):
        return histograms.reshape(-1)


def blob_faces(count, seed):
    """Crops (N, 48, 48) and the true landmarks (N, 4, 2) in them."""
    rng = np.random.default_rng(seed)
    turns, sizes = rng.normal(0, 0.1, count), np.exp(rng.normal(0, 0.06, count))
    rotations = np.stack([np.cos(turns), np.sin(turns), -np.sin(turns), np.cos(turns)], 1).reshape(-1, 2, 2)
    centres = FRAME.middle + rng.normal(0, 1.5, (count, 1, 2))
    landmarks = sizes[:, None, None] * MEAN @ rotations + centres + rng.normal(0, 0.7, (count, 4, 2))
    y, x = np.mgrid[: FRAME.crop, : FRAME.crop]
    crops = 30 + 15 * ndimage.gaussian_filter(rng.normal(size=(count, FRAME.crop, FRAME.crop)), (0, 1.5, 1.5))
    for point in landmarks.swapaxes(0, 1)[..., None, None]:
        crops += 180 * np.exp(-((x - point[:, 0]) ** 2 + (y - point[:, 1]) ** 2) / (2 * 3**2))
    return crops.clip(0, 255).astype(np.uint8), landmarks.astype(np.float32)


def shape_model_space(landmarks):
    """The parametric method's space, learned from faces."""
    return learn_similarity_asm(jnp.asarray(landmarks), FRAME.face, 0.9, None)


def training_set(crops, landmarks):
    """Every crop once, as it is."""
    pivots = np.full((len(crops), 2), FRAME.middle, np.float32)
    return TrainingSet(crops, landmarks, np.zeros(len(crops), bool), np.arange(len(crops)), pivots)


def mean_error(found, landmarks):
    """Mean distance of landmarks from the true ones, in pixels."""
    return np.linalg.norm(np.asarray(found) - landmarks, axis=-1).mean()
