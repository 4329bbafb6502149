"""Models and a detector that take no time to make: random cascades of AFLW's 21 landmarks, faces by a pixel's value."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jax import numpy as jnp

from jaxfit.cascade.model import Cascade
from jaxfit.cascade.starts import Spread
from jaxfit.data.detectors import Detection
from jaxfit.descriptors.dense import Dense
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.descriptors.sift import Sift
from jaxfit.heads.model import load_head_model
from jaxfit.image.frame import Frame
from jaxfit.models.model import SQUARE, Model
from jaxfit.models.placements import Placement
from jaxfit.schemes.known import AFLW21
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.points import PointSpace
from jaxfit.shapes.similarity import SimilarityASM

FRAME = Frame(48, 28.0)
PLACEMENTS = {
    SQUARE: Placement((0.01, -0.02), 0.1, Spread((0.05, 0.06), 0.07, 0.08)),
    "haar-frontal": Placement((0.03, 0.08), -0.2, Spread((0.05, 0.06), 0.07, 0.08)),
}


def random_cascade(space: Any, descriptor: Descriptor, rank: int | None = None) -> Cascade:
    """Two random steps, which move faces by some pixels and leave them finite."""
    rng = np.random.default_rng(0)
    outputs = rank or space.size
    weights = rng.normal(0, 0.05, (2, AFLW21.count * descriptor.size, outputs)).astype(np.float16)
    directions = None if rank is None else jnp.asarray(rng.normal(size=(2, rank, space.size)), jnp.float32)
    return Cascade(
        space=space,
        weights=tuple(jnp.asarray(weights, jnp.float32)),
        biases=jnp.asarray(rng.normal(0, 0.02, (2, space.size)), jnp.float32),
        windows=jnp.array([14.0, 9.0]),
        descriptor=descriptor,
        frame=FRAME,
        directions=directions,
    )


def random_model(method: str) -> Model:
    """A model of a method."""
    in_cm = load_head_model().of(AFLW21, 0.7)
    size = FRAME.face / float(np.ptp(np.asarray(in_cm.mean)[:, :2], 0).max())  # pixels a cm
    shape = ActiveShapeModel(size * in_cm.mean, in_cm.modes, size * in_cm.deviations)
    flat = ActiveShapeModel(shape.mean[:, :2], shape.modes[..., :2], shape.deviations)
    head = CameraASM(shape, jnp.float32(3.5))
    cascade = {
        "sdm": lambda: random_cascade(PointSpace(flat.mean), Sift()),
        "parametric": lambda: random_cascade(SimilarityASM(flat, jnp.float32(3.5)), Dense("face"), rank=3),
        "alignment3d": lambda: random_cascade(SimilarityASM(flat, jnp.float32(3.5)), Sift("face")),
        "regression3d": lambda: random_cascade(head, Sift()),
    }[method]()
    return Model(cascade, AFLW21, PLACEMENTS, {}, head if method == "alignment3d" else None)


@dataclass(frozen=True)
class Corners:
    """Finds as many faces as the first pixel says: squares along the upper edge, each ten pixels larger."""

    kinds: tuple[str, ...] = (SQUARE,)
    colour: bool = False
    rough: bool = True

    def __call__(self, image: np.ndarray) -> list[Detection]:
        return [Detection(np.array([20.0 * k, 0, 30 + 10 * k, 30 + 10 * k]), SQUARE) for k in range(image.flat[0])]


def with_corners(faces: int) -> np.ndarray:
    """A grey picture in which `Corners` finds so many faces."""
    picture = np.random.default_rng(faces).integers(0, 256, (90, 120), dtype=np.uint8)
    picture[0, 0] = faces
    return picture
