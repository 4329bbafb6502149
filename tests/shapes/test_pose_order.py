"""Poses of heads that are turned in the picture."""

import numpy as np

from jaxfit.shapes.pose_order import turned_poses

POSES = np.array([[10.0, 0, 0], [-20, 5, 30], [0, -15, -60], [np.nan] * 3])


def test_heads_that_face_us_roll_as_they_are_turned() -> None:
    assert np.allclose(turned_poses(POSES[:1], np.array([25.0])), [[35, 0, 0]])


def test_several_heads_are_turned_as_each_alone_and_back_again() -> None:
    degrees = np.array([25.0, -40, 0, 10])
    several = turned_poses(POSES, degrees)
    alone = [turned_poses(POSES[[row]], degrees[[row]])[0] for row in range(len(POSES))]
    assert np.allclose(several, alone, equal_nan=True)
    assert not np.allclose(several[:2], POSES[:2])
    assert np.allclose(turned_poses(several, -degrees), POSES, equal_nan=True)
