"""From a face box to the first belief about the face: statistics of each kind of box, measured on labelled faces.

Those of the detectors that we know come with the package, for each scheme of landmarks (``placements.json``, written by
``scripts/measure_boxes.py``); a model may have measured others on its own training faces.
"""

import json
import math
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp

from jaxfit.cascade.starts import Spread
from jaxfit.data.boxes import box_centre
from jaxfit.data.crops import turned
from jaxfit.errors import InputError
from jaxfit.shapes.procrustes import align_similarity


@dataclass(frozen=True)
class Placement:
    """How faces lie in one kind of box, in sides of the box (the mean of its width and height).

    Attributes:
        shift: mean offset of the face's centre from the box's, x and y.
        log_scale: mean logarithm of the ratio of the face's size to the box's side.
        spread: the standard deviations.
    """

    shift: tuple[float, float]
    log_scale: float
    spread: Spread

    def face_in(self, box: np.ndarray, rotation: float = 0.0) -> tuple[np.ndarray, float]:
        """The expected centre (2,) and size, in pixels of the picture, of the face in a box (4,), which is turned in
        the picture by ``rotation``, in radians, clockwise as seen. Its size in the box hardly depends on that."""
        x, y, width, height = box.tolist()  # plain numbers: on arrays of two it takes as long as much of the cutting
        side = (width + height) / 2
        right, down = self.shift
        if rotation:
            cos, sin = math.cos(rotation), math.sin(rotation)
            right, down = right * cos - down * sin, right * sin + down * cos
        centre = x + width / 2 + right * side, y + height / 2 + down * side
        return np.array(centre), side * self._ratio

    @cached_property
    def _ratio(self) -> float:
        """Of the face's size to the box's side."""
        return float(np.exp(self.log_scale))


@cache
def placements_of(scheme: str) -> dict[str, Placement]:
    """How faces with landmarks of a scheme lie in the boxes of detectors, by the kind of box; empty if unknown."""
    known = json.loads((resources.files("jaxfit.models") / "placements.json").read_text("utf-8"))
    return {kind: read_placement(values) for kind, values in known.get(scheme, {}).items()}


def read_placement(values: dict[str, Any]) -> Placement:
    """A placement from the JSON values of its fields, whose numbers are not checked."""
    spread = values["spread"]
    return Placement(
        shift=(float(values["shift"][0]), float(values["shift"][1])),
        log_scale=float(values["log_scale"]),
        spread=Spread(
            (float(spread["shift"][0]), float(spread["shift"][1])),
            float(spread["log_scale"]),
            float(spread["rotation"]),
        ),
    )


def measure_placement(
    boxes: np.ndarray, landmarks: np.ndarray, mean: np.ndarray, face: float, rotations: np.ndarray | None = None
) -> Placement:
    """How the mean face lies in boxes, when aligned to the true faces.

    Args:
        boxes: (N, 4), one a face.
        landmarks: (N, L, 2) true landmarks in the pixels of the same pictures.
        mean: (L, 2) the mean face, its centroid at the origin.
        face: the mean face's size in its own pixels.
        rotations: (N,) how far the faces are turned, in degrees, clockwise as seen, as the source of the boxes says;
            None: unknown.

    Raises:
        InputError: fewer than two faces.
    """
    if len(boxes) < 2:
        raise InputError(f"expected at least two faces to measure how faces lie in their boxes; got {len(boxes)}")
    # Relative to the box first: float32 would lose sub-pixels in the corner of a large picture.
    centres = np.stack([box_centre(box) for box in boxes])
    sides = np.array([_side(box) for box in boxes])
    relative = (landmarks - centres[:, None]) / sides[:, None, None]
    radians = np.radians(np.zeros(len(boxes)) if rotations is None else rotations)
    relative = turned(relative, -radians[:, None])
    aligned = jax.vmap(align_similarity, (0, None))(jnp.asarray(relative, jnp.float32), jnp.asarray(mean, jnp.float32))
    shifts = np.asarray(aligned.centre, np.float64)
    log_scales = np.log(np.asarray(aligned.scale, np.float64) * face)
    return Placement(
        shift=(float(shifts[:, 0].mean()), float(shifts[:, 1].mean())),
        log_scale=float(log_scales.mean()),
        spread=Spread(
            shift=(float(shifts[:, 0].std()), float(shifts[:, 1].std())),
            log_scale=float(log_scales.std()),
            rotation=float(np.std(aligned.rotation)),
        ),
    )


def _side(box: np.ndarray) -> float:
    return float(box[2] + box[3]) / 2
