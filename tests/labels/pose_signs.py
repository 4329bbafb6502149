"""How labelled points say which way a head is turned."""

import numpy as np


def depth_below_the_eyes(points: np.ndarray, left: np.ndarray, right: np.ndarray, mouth: np.ndarray) -> np.ndarray:
    """Distances (N,) of points (N, 2) below the line through the eyes, relative to the mouth's."""
    line, middle = right - left, (left + right) / 2
    below = np.stack([-line[:, 1], line[:, 0]], 1)
    return ((points - middle) * below).sum(1) / ((mouth - middle) * below).sum(1)


def correlation(one: np.ndarray, other: np.ndarray, chosen: np.ndarray) -> float:
    """Of the chosen numbers, where both are known."""
    use = np.isfinite(one + other) & chosen
    return float(np.corrcoef(one[use], other[use])[0, 1])
