"""Landmarks drawn over pictures."""

from itertools import pairwise

import cv2
import numpy as np

from jaxfit.data.boxes import bounding_square
from jaxfit.exceptions import InputError
from jaxfit.shapes.schemes import Scheme

_CYAN, _RED, _YELLOW = (0, 255, 255), (255, 60, 60), (255, 220, 0)
_BITS = 4  # OpenCV takes coordinates as integers; these are binary digits after the point
_FARTHEST = 2.0**15  # pixels; beyond, OpenCV's integers overflow


def draw_landmarks(
    rgb: np.ndarray,
    landmarks: np.ndarray,
    scheme: Scheme,
    box: np.ndarray | None = None,
    truth: np.ndarray | None = None,
) -> np.ndarray:
    """A copy, uint8 (H, W, 3), of an RGB or grey picture with a face's landmarks drawn over it.

    Lines and points are as thick as the face is large. Points that are NaN, and lines to them, are left out.

    Args:
        rgb: (H, W, 3) or (H, W) uint8.
        landmarks: (L, 2) pixels, drawn in cyan.
        scheme: says which points lines join.
        box: (4,) x, y, width, height of the face box, drawn in yellow.
        truth: (L, 2) pixels, the labels, drawn in red below the landmarks.

    Raises:
        InputError: not as many landmarks as the scheme has.
    """
    canvas = cv2.cvtColor(rgb, cv2.COLOR_GRAY2RGB) if rgb.ndim == 2 else rgb.copy()
    if box is not None and np.isfinite(box).all():
        x, y, width, height = box
        corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])
        _lines(canvas, corners, ((0, 1, 2, 3, 0),), _YELLOW)
    for points, colour in ((truth, _RED), (landmarks, _CYAN)):
        if points is not None:
            _face(canvas, points, scheme, colour)
    return canvas


def _face(canvas: np.ndarray, points: np.ndarray, scheme: Scheme, colour: tuple[int, int, int]) -> None:
    if points.shape != (scheme.count, 2):
        raise InputError(f"expected ({scheme.count}, 2) landmarks of scheme {scheme.name}, got {points.shape}")
    if not np.isfinite(points).all(1).any():
        return
    _lines(canvas, points, scheme.lines, colour)
    radius = round(max(1.0, 0.009 * _extent(points, canvas)) * 2**_BITS)
    for point in points[np.isfinite(points).all(1)]:
        cv2.circle(canvas, _fixed(point), radius, colour, cv2.FILLED, cv2.LINE_AA, _BITS)


def _lines(
    canvas: np.ndarray, points: np.ndarray, lines: tuple[tuple[int, ...], ...], colour: tuple[int, int, int]
) -> None:
    thickness = max(1, round(0.004 * _extent(points, canvas)))
    for line in lines:
        for start, end in pairwise(line):
            if np.isfinite(points[[start, end]]).all():
                cv2.line(canvas, _fixed(points[start]), _fixed(points[end]), colour, thickness, cv2.LINE_AA, _BITS)


def _extent(points: np.ndarray, canvas: np.ndarray) -> float:
    """Size of the face in pixels; not more than the picture's, lest one stray point make everything thick."""
    return float(min(bounding_square(points)[2], max(canvas.shape)))


def _fixed(point: np.ndarray) -> tuple[int, int]:
    """A point as OpenCV's fixed-point numbers."""
    x, y = np.round(np.clip(point, -_FARTHEST, _FARTHEST) * 2**_BITS).astype(int)
    return int(x), int(y)
