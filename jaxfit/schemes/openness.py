"""How far eyes and mouths are open: the gap of lids or lips over the distance of the corners.

For eyes this is the eye aspect ratio of Soukupova and Cech (Real-time eye blink detection using facial landmarks,
2016), for the mouth the same of the inner lips. It has no unit, and does not depend on how large a face is or how far
it is turned in the picture; of heads that are turned aside, corners come together, and it grows.
"""

from dataclasses import dataclass

import numpy as np

from jaxfit.schemes.known import IBUG68, LFPW27, LFPW27_NAMES, LFPW29, LFPW29_NAMES
from jaxfit.schemes.scheme import Scheme


@dataclass(frozen=True)
class Opening:
    """An eye or a mouth of a scheme.

    Attributes:
        name: what it is; left and right are those of the picture.
        corners: indices of its left and right corner, in either order.
        gaps: pairs of indices, of the upper and the lower lid or lip opposite to it.
    """

    name: str
    corners: tuple[int, int]
    gaps: tuple[tuple[int, int], ...]


def _of_lfpw(names: tuple[str, ...]) -> tuple[Opening, ...]:
    def opening(name: str, *points: str) -> Opening:
        first, second, upper, lower = map(names.index, points)
        return Opening(name, (first, second), ((upper, lower),))

    sides = [
        opening(f"{side}_eye", *(f"{side}_eye_{point}" for point in ("out", "in", "center_top", "center_bottom")))
        for side in ("left", "right")
    ]
    lips = ("mouth_center_top_lip_bottom", "mouth_center_bottom_lip_top")
    return (*sides, opening("mouth", "left_mouth_out", "right_mouth_out", *lips))


# By the names of the schemes.
_OPENINGS = {
    IBUG68.name: (
        Opening("left_eye", (36, 39), ((37, 41), (38, 40))),
        Opening("right_eye", (42, 45), ((43, 47), (44, 46))),
        Opening("mouth", (60, 64), ((61, 67), (62, 66), (63, 65))),
    ),
    LFPW29.name: _of_lfpw(LFPW29_NAMES),
    LFPW27.name: _of_lfpw(LFPW27_NAMES),
}


def openings_of(scheme: Scheme) -> tuple[Opening, ...]:
    """The eyes and mouths whose openness a scheme's landmarks say; none of schemes without lids and lips."""
    return _OPENINGS.get(scheme.name, ())


def openness(landmarks: np.ndarray, scheme: Scheme) -> np.ndarray:
    """How far the K `openings_of` a scheme are open, (..., K), of landmarks (..., L, 2): the mean gap over the distance
    of the corners.

    0 is closed; an open eye has about 0.3. NaN where a landmark is, or where two corners are one point.
    """
    points = np.asarray(landmarks, np.float64)

    def apart(pairs: tuple[tuple[int, int], ...]) -> np.ndarray:
        first, second = np.transpose(pairs)
        return np.asarray(np.linalg.norm(points[..., first, :] - points[..., second, :], axis=-1).mean(-1))

    openings = openings_of(scheme)
    values = np.full((*points.shape[:-2], len(openings)), np.nan)
    for number, opening in enumerate(openings):
        width = apart((opening.corners,))
        np.divide(apart(opening.gaps), width, out=values[..., number], where=width > 0)
    return values
