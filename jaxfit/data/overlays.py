"""Landmarks and heads drawn over pictures."""

import math
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from jax import numpy as jnp

from jaxfit.cascade.uncertainty import region_radius
from jaxfit.data.boxes import bounding_square
from jaxfit.data.crops import turned
from jaxfit.data.pictures import Pixels, to_eight_bits
from jaxfit.data.rows import Row
from jaxfit.errors import InputError
from jaxfit.modes import computing
from jaxfit.schemes.known import SCHEMES
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.camera import pose_rotation

_CYAN, _RED, _YELLOW, _ORANGE = (0, 255, 255), (255, 60, 60), (255, 220, 0), (255, 140, 0)
_AXES = ((255, 0, 0), (0, 230, 0), (40, 90, 255))  # colours of the head's x, y and z
_AXIS = 0.6  # length of an axis, in sizes of the face
_FRONT, _BEHIND = (255, 70, 200), (150, 60, 130)  # colours of the head box
_MARGIN = 0.1  # between the landmarks and the head box, in sizes of the face
_BOLD = 3.0  # thickness of the axes and of the head box's front, in landmarks' lines
_DARKEST = 0.1  # of the colour map; below, far points vanish in dark pictures
# A cuboid's corners, front face first, as which end of x, y and z they lie at, and the edges between them.
_CORNERS = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
_FRONT_EDGES = ((0, 1, 2, 3, 0),)
_OTHER_EDGES = ((4, 5, 6, 7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
# In so small a face, lines of a pixel would hide it: only points are drawn, not much larger.
_SMALL, _MANY, _LEAST_RADIUS = 60, 20, 0.4
_LEAST_LETTERS = 0.4  # height of the smallest letters that can be read, in those of OpenCV's font
_SEEN = 0.5  # probability from which a point can rather be seen than not
_HELD = 0.9  # share of the true points that lie in the ellipses
_BITS = 4  # OpenCV takes coordinates as integers; these are binary digits after the point
_FARTHEST = 2.0**15  # pixels; beyond, OpenCV's integers overflow


def draw_landmarks(
    rgb: Pixels,
    landmarks: np.ndarray,
    scheme: Scheme,
    box: np.ndarray | None = None,
    truth: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
    visible: np.ndarray | None = None,
) -> np.ndarray:
    """A copy, uint8 (H, W, 3), of an RGB or grey picture with a face's landmarks drawn over it.

    Lines and points are as thick as the face is large. Points that are NaN, and lines to them, are left out. Points
    that are rather hidden than not are hollow; those of a scheme of your own have numbers. Ellipses hold the true
    point in 90 of 100 cases.

    Args:
        rgb: a picture as in `jaxfit.data.pictures.to_eight_bits`.
        landmarks: (L, 2) pixels, drawn in cyan.
        scheme: says which points lines join.
        box: (4,) x, y, width, height of the face box, drawn in yellow.
        truth: (L, 2) pixels, the labels, drawn in red below the landmarks.
        covariances: (L, 2, 2) of the landmarks, in squares of pixels.
        visible: (L,) probabilities that they can be seen.

    Raises:
        ImageError: no such picture.
        InputError: not as many landmarks as the scheme has.
    """
    canvas = _canvas(rgb, box)
    if truth is not None:
        _face(canvas, truth, scheme, _RED)
    _face(canvas, landmarks, scheme, _CYAN, visible)
    if covariances is not None:
        _ellipses(canvas, landmarks, covariances, _CYAN)
    return canvas


def draw_head(
    rgb: Pixels,
    landmarks_3d: np.ndarray,
    pose: np.ndarray,
    scheme: Scheme,
    box: np.ndarray | None = None,
    truth: np.ndarray | None = None,
) -> np.ndarray:
    """A copy, uint8 (H, W, 3), of an RGB or grey picture with a 3D fit drawn over it.

    Nearer landmarks are brighter and warmer. A cross at their mean shows the head's axes: x (red) and
    y (green) point to image right and down in a frontal face, z (blue) where the face looks. A cuboid, its front face
    drawn brighter, encloses the head. What is NaN, and what depends on it, is left out.

    Args:
        rgb: a picture as in `jaxfit.data.pictures.to_eight_bits`.
        landmarks_3d: (L, 3) x and y in pixels, z in the same units, away from the viewer.
        pose: (3,) roll, pitch, yaw in degrees.
        scheme: says which points lines join.
        box: (4,) x, y, width, height of the face box, drawn in yellow.
        truth: (L, 2) pixels, the labels, drawn in red below all else but the box.

    Raises:
        ImageError: no such picture.
        InputError: not as many landmarks as the scheme has, or a pose that is not three angles.
    """
    if landmarks_3d.shape != (scheme.count, 3):
        raise InputError(f"expected ({scheme.count}, 3) landmarks of scheme {scheme.name}, got {landmarks_3d.shape}")
    if pose.shape != (3,):
        raise InputError(f"expected a pose (3,) of roll, pitch and yaw, got {pose.shape}")
    canvas = _canvas(rgb, box)
    if truth is not None:
        _face(canvas, truth, scheme, _RED)
    known = np.isfinite(landmarks_3d).all(1)
    if not known.any():
        return canvas
    points = np.where(known[:, None], np.clip(landmarks_3d, -_FARTHEST, _FARTHEST), np.nan)
    if not np.isfinite(pose).all():
        _depths(canvas, points, scheme)
        return canvas
    outline = outline_of(points[known], pose)
    thickness = _thickness(points[:, :2], canvas)
    _lines(canvas, outline.corners[:, :2], _OTHER_EDGES, _BEHIND, thickness)
    _lines(canvas, outline.corners[:, :2], _FRONT_EDGES, _FRONT, _BOLD * thickness)
    _depths(canvas, points, scheme)
    _axes(canvas, outline.axes, _BOLD * thickness)
    return canvas


class Outline(NamedTuple):
    """A head as a box and a cross.

    Attributes:
        corners: (8, 3) of a cuboid around the head: the four of its front, clockwise from the upper left of a frontal
            face, then those behind them.
        axes: (4, 3) where the axes meet, and the tips of x, y and z: to the head's left, down, and ahead.
    """

    corners: np.ndarray
    axes: np.ndarray


@computing
def outline_of(landmarks_3d: np.ndarray, pose: np.ndarray) -> Outline:
    """The outline of a head from its landmarks (L, 3) and its roll, pitch and yaw (3,) in degrees, all finite."""
    rotation = np.asarray(pose_rotation(jnp.asarray(pose, jnp.float32)), np.float64)
    corners, size = _head_box(landmarks_3d, rotation)
    origin = landmarks_3d.mean(0)
    tips = origin + (rotation * _AXIS * size * [1, 1, -1]).T  # the face looks along -z
    return Outline(corners, np.vstack([origin, tips]))


def draw_row(rgb: Pixels, row: Row, scheme: Scheme, boxed: bool = True) -> np.ndarray:
    """A copy, uint8 (H, W, 3), of an RGB or grey picture with a fitted face drawn over it, in 3D if the model has that.
    A fit that is not ok is drawn in orange.

    Args:
        rgb: a picture as in `jaxfit.data.pictures.to_eight_bits`.
        row: the face, as `jaxfit.Fits.rows` gives it.
        scheme: says which points lines join.
        boxed: draw the face box, too.
    """
    canvas = _canvas(rgb, None)
    if boxed:
        corners = _turned_corners(box_of(row), row["box"]["rotation"])
        _lines(canvas, corners, ((0, 1, 2, 3, 0),), _YELLOW if row["ok"] else _ORANGE, _thickness(corners, canvas))
    solid = solid_points(row)
    if solid is None or not row["ok"]:
        points, colour = np.array(row["landmarks"]), _CYAN if row["ok"] else _ORANGE
        _face(canvas, points, scheme, colour, np.array(row["visible"]) if "visible" in row else None)
        if "covariances" in row:
            xx, xy, yy = np.array(row["covariances"]).T
            _ellipses(canvas, points, np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2), colour)
        return canvas
    return draw_head(canvas, solid, np.array(list(row["pose"].values())), scheme)


def box_of(row: Row) -> np.ndarray:
    """The box (4,) of a fitted face."""
    return np.array([row["box"][side] for side in ("x", "y", "width", "height")])


def _turned_corners(box: np.ndarray, degrees: float) -> np.ndarray:
    """The corners (4, 2) of a box (4,), turned about its middle, clockwise as seen."""
    x, y, width, height = box
    corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])
    middle = corners.mean(0)
    return turned(corners - middle, np.radians(degrees)) + middle


def solid_points(row: Row) -> np.ndarray | None:
    """The points (L, 3) of a fitted face that are drawn: the 2D landmarks at the depths of the 3D shape, which in
    alignments lies beside them. None where there is no 3D shape."""
    if "landmarks_3d" not in row:
        return None
    return np.column_stack([np.array(row["landmarks"]), np.array(row["landmarks_3d"])[:, 2]])


def draw_name(rgb: Pixels, name: str, box: np.ndarray, ok: bool = True) -> np.ndarray:
    """A copy, uint8 (H, W, 3), of an RGB or grey picture with a face's name written above its box (4,); in orange if
    its fit is not ok."""
    canvas = _canvas(rgb, None)
    height = max(_LEAST_LETTERS, 0.0025 * min(box[2], max(canvas.shape)))  # of the letters, in those of OpenCV's font
    width = max(1, round(2 * height))
    (wide, high), below = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, height, 3 * width)
    # Of faces at the edges, within the picture: below their upper edge, or farther left.
    least, most = np.array([2, high + 2]), np.array(canvas.shape[1::-1]) - [wide + 2, below + 2]
    place = np.maximum(least, np.minimum(most, np.clip(box[:2], -_FARTHEST, _FARTHEST) - [0, 4]))
    for colour, thickness in (
        ((0, 0, 0), 3 * width),
        (_YELLOW if ok else _ORANGE, width),
    ):  # its outline first: readable on any ground
        corner = tuple(np.round(place).astype(int).tolist())
        cv2.putText(canvas, name, corner, cv2.FONT_HERSHEY_SIMPLEX, height, colour, thickness, cv2.LINE_AA)
    return canvas


def _canvas(rgb: Pixels, box: np.ndarray | None) -> np.ndarray:
    """A copy (H, W, 3) of a picture with the face box, if there is one."""
    rgb = to_eight_bits(rgb)
    canvas = cv2.cvtColor(rgb, cv2.COLOR_GRAY2RGB) if rgb.ndim == 2 else rgb.copy()
    if box is not None and np.isfinite(box).all():
        x, y, width, height = box
        corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])
        _lines(canvas, corners, ((0, 1, 2, 3, 0),), _YELLOW, _thickness(corners, canvas))
    return canvas


def _face(
    canvas: np.ndarray,
    points: np.ndarray,
    scheme: Scheme,
    colour: tuple[int, int, int],
    visible: np.ndarray | None = None,
) -> None:
    if points.shape != (scheme.count, 2):
        raise InputError(f"expected ({scheme.count}, 2) landmarks of scheme {scheme.name}, got {points.shape}")
    if not np.isfinite(points).all(1).any():
        return
    thickness = _thickness(points, canvas)
    small = _is_small(points)
    if not small:
        _lines(canvas, points, scheme.lines, colour, thickness)
    for number in np.flatnonzero(np.isfinite(points).all(1)):
        hollow = visible is not None and bool(visible[number] < _SEEN)
        _dot(canvas, points[number], colour, thickness, small, hollow)
        if not small and len(points) > 1 and scheme.name not in SCHEMES:
            _number(canvas, points[number], int(number) + 1, colour, thickness)


def _number(canvas: np.ndarray, point: np.ndarray, number: int, colour: tuple[int, int, int], thickness: float) -> None:
    """The number of a point (2,) beside it: of points that have no names that all know."""
    height = max(_LEAST_LETTERS, 0.4 * thickness)
    corner = tuple(np.round(np.clip(point, -_FARTHEST, _FARTHEST) + 4 * max(1.0, thickness)).astype(int).tolist())
    width = max(1, round(height))
    for shade, wide in (((0, 0, 0), 3 * width), (colour, width)):  # its outline first: readable on any ground
        cv2.putText(canvas, str(number), corner, cv2.FONT_HERSHEY_SIMPLEX, height, shade, wide, cv2.LINE_AA)


def _ellipses(canvas: np.ndarray, points: np.ndarray, covariances: np.ndarray, colour: tuple[int, int, int]) -> None:
    """The regions of the points (L, 2) by their covariances (L, 2, 2), as thin lines; none on small faces."""
    if _is_small(points):
        return
    radius = region_radius(_HELD)
    for point, covariance in zip(points, covariances, strict=True):
        if not (np.isfinite(point).all() and np.isfinite(covariance).all()):
            continue
        variances, axes = np.linalg.eigh(covariance)
        across, along = radius * np.sqrt(np.clip(variances, 0.0, _FARTHEST))
        x, y = axes[:, 1]
        lengths = tuple(round(float(length) * 2**_BITS) for length in (along, across))
        degrees = math.degrees(math.atan2(y, x))
        cv2.ellipse(canvas, _fixed(point), lengths, degrees, 0, 360, colour, 1, cv2.LINE_AA, _BITS)


def _depths(canvas: np.ndarray, points: np.ndarray, scheme: Scheme) -> None:
    """Landmarks (L, 3) and their lines, from far to near, coloured by depth."""
    flat, depths = points[:, :2], points[:, 2]
    thickness = _thickness(flat, canvas)
    nearest, farthest = np.nanmin(depths), np.nanmax(depths)

    def colour(depth: float) -> tuple[int, int, int]:
        nearness = (farthest - depth) / (farthest - nearest) if farthest > nearest else 1.0
        level = np.array([[255 * (_DARKEST + (1 - _DARKEST) * nearness)]]).astype(np.uint8)
        blue, green, red = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[0, 0].tolist()
        return red, green, blue

    edges = [(depths[list(edge)].mean(), edge) for line in scheme.lines for edge in pairwise(line)]
    small = _is_small(flat)
    known = (item for item in edges if not small and np.isfinite(item[0]))
    for depth, edge in sorted(known, reverse=True):
        _lines(canvas, flat, (edge,), colour(depth), thickness)
    for index in np.argsort(-depths)[: np.isfinite(depths).sum()]:  # NaN comes last
        _dot(canvas, flat[index], colour(depths[index]), thickness, small)


def _axes(canvas: np.ndarray, axes: np.ndarray, thickness: float) -> None:
    """The head's axes (4, 3), as in `Outline`; those that point away lie below."""
    for index in np.argsort(-axes[1:, 2]).tolist():
        _lines(canvas, axes[:, :2], ((0, index + 1),), _AXES[index], thickness)
        _dot(canvas, axes[index + 1, :2], _AXES[index], thickness)  # all there is of an axis along the line of sight


def _head_box(points: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, float]:
    """Corners (8, 3), ordered as ``_CORNERS``, of a head with the landmarks (L, 3), and the size of its face."""
    upright = points @ rotation
    low, high = upright.min(0), upright.max(0)
    size = (high - low)[:2].max()
    high[2] = max(high[2], low[2] + size)  # landmarks end at the ears; a head is about as deep as its face is large
    low, high = low - _MARGIN * size, high + _MARGIN * size
    return np.where(_CORNERS, high, low) @ rotation.T, float(size)


def _is_small(points: np.ndarray) -> bool:
    """Whether the landmarks (L, 2) of a face are so close together that lines would hide it."""
    known = np.isfinite(points).all(1)
    return bool(known.sum() > _MANY and bounding_square(points)[2] < _SMALL)


def _dot(
    canvas: np.ndarray,
    point: np.ndarray,
    colour: tuple[int, int, int],
    thickness: float,
    small: bool = False,
    hollow: bool = False,
) -> None:
    """A point (2,) that shows on lines of some thickness; of a small face without lines, as small as can be."""
    radius = round((_LEAST_RADIUS if small else max(1.0, 2.25 * thickness)) * 2**_BITS)
    if not hollow:
        cv2.circle(canvas, _fixed(point), radius, colour, cv2.FILLED, cv2.LINE_AA, _BITS)
    elif not small:  # of a small face, there is no room for what is hidden
        cv2.circle(canvas, _fixed(point), 2 * radius, colour, max(1, round(thickness / 2)), cv2.LINE_AA, _BITS)


def _lines(
    canvas: np.ndarray,
    points: np.ndarray,
    lines: tuple[tuple[int, ...], ...],
    colour: tuple[int, int, int],
    thickness: float,
) -> None:
    width = max(1, round(thickness))
    for line in lines:
        for start, end in pairwise(line):
            if np.isfinite(points[[start, end]]).all():
                cv2.line(canvas, _fixed(points[start]), _fixed(points[end]), colour, width, cv2.LINE_AA, _BITS)


def _thickness(points: np.ndarray, canvas: np.ndarray) -> float:
    """Of the lines of a face (L, 2), in pixels: by its size, or the picture's if one stray point makes it larger."""
    return 0.004 * float(min(bounding_square(points)[2], max(canvas.shape)))


def _fixed(point: np.ndarray) -> tuple[int, int]:
    """A point as OpenCV's fixed-point numbers."""
    x, y = np.round(np.clip(point, -_FARTHEST, _FARTHEST) * 2**_BITS).astype(int)
    return int(x), int(y)
