"""Poses on the host: in other orders of their three rotations than Eq. 15's, and in turned pictures."""

from collections.abc import Sequence

import numpy as np
import scipy

from jaxfit.errors import InputError
from jaxfit.shapes.camera import ANGLES, DEFAULT_ORDER, PoseOrder


def in_order(poses: np.ndarray, orders: Sequence[PoseOrder], given: Sequence[PoseOrder] | None = None) -> np.ndarray:
    """Poses (N, 3) of the same heads in other orders, such as those that the faces' true poses are given in.

    Args:
        poses: roll, pitch and yaw in degrees.
        orders: N, that they shall be in.
        given: N, that they are in; None: Eq. 15's, as jaxfit gives them.

    Raises:
        InputError: the poses are not (N, 3).
    """
    poses = as_poses(poses).copy()
    wanted, own = np.array(orders), np.array([DEFAULT_ORDER] * len(poses) if given is None else given)
    known = np.isfinite(poses).all(1)
    if len(rows := np.flatnonzero(known & (own == DEFAULT_ORDER) & (wanted == "roll-yaw-pitch"))):
        roll, pitch, yaw = poses[rows].T
        # About axes that turn with the head; y is down, so that looking up turns against the axis.
        turns = scipy.spatial.transform.Rotation.from_euler("YXZ", np.stack([yaw, -pitch, roll], 1), degrees=True)
        pitch, yaw, roll = turns.as_euler("XYZ", degrees=True).T * [[-1], [1], [1]]
        # Of the two triples that give a rotation, the one of a head that is not upside down: SciPy keeps yaw within 90.
        over = np.abs(pitch) > 90
        found = np.stack([roll, pitch, yaw], 1)
        poses[rows] = np.where(over[:, None], wrapped_degrees(np.stack([roll + 180, pitch + 180, 180 - yaw], 1)), found)
    if len(rows := np.flatnonzero(known & (own == "roll-yaw-pitch") & (wanted == DEFAULT_ORDER))):
        roll, pitch, yaw = poses[rows].T
        turns = scipy.spatial.transform.Rotation.from_euler("XYZ", np.stack([-pitch, yaw, roll], 1), degrees=True)
        yaw, pitch, roll = turns.as_euler("YXZ", degrees=True).T * [[1], [-1], [1]]
        poses[rows] = np.stack([roll, pitch, yaw], 1)
    return poses


def turned_poses(poses: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Poses (N, 3), in Eq. 15's order, of heads that are turned in the picture by angles (N,), clockwise as seen."""
    rows = np.flatnonzero(np.isfinite(poses).all(1) & (degrees != 0))
    turned = poses.copy()
    if len(rows):
        roll, pitch, yaw = poses[rows].T
        rotation = scipy.spatial.transform.Rotation
        heads = rotation.from_euler("YXZ", np.stack([yaw, -pitch, roll], 1), degrees=True)
        yaw, pitch, roll = (rotation.from_euler("Z", degrees[rows, None], degrees=True) * heads).as_euler("YXZ", True).T
        turned[rows] = np.stack([roll, -pitch, yaw], 1)
    return turned


def as_poses(poses: np.ndarray) -> np.ndarray:
    """Poses (N, 3), float64, NaN wherever they are not finite.

    Raises:
        InputError: another shape.
    """
    poses = as_triples(poses, "poses")
    return np.where(np.isfinite(poses), poses, np.nan)


def as_triples(values: np.ndarray, what: str) -> np.ndarray:
    """Three numbers a face, (N, 3) float64; ``what`` they are is for the message.

    Raises:
        InputError: another shape.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != len(ANGLES):
        raise InputError(f"{what} must be roll, pitch and yaw of each face, (faces, 3); got {values.shape}")
    return values


def wrapped_degrees(angles: np.ndarray) -> np.ndarray:
    """Angles in degrees, brought into [-180, 180)."""
    return (angles + 180.0) % 360.0 - 180.0
