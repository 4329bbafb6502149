"""How faces lie in boxes: known placements are recovered."""

import numpy as np
import pytest

from jaxfit.errors import InputError
from jaxfit.models.placements import measure_placement

MEAN = np.array([[-30.0, -30.0], [30.0, -30.0], [0.0, 0.0], [-20.0, 30.0], [20.0, 30.0]])
FACE = 60.0


def test_known_placements_are_recovered() -> None:
    rng = np.random.default_rng(0)
    count = 4000
    centres, sides = rng.uniform(500, 3000, (count, 2)), rng.uniform(20, 800, count)
    shifts = rng.normal([0.05, -0.1], [0.03, 0.06], (count, 2))
    log_scales, rotations = rng.normal(-0.2, 0.09, count), rng.normal(0, 0.12, count)
    cos, sin = np.cos(rotations), np.sin(rotations)
    x, y = MEAN[:, 0], MEAN[:, 1]
    turned = np.stack([np.outer(cos, x) - np.outer(sin, y), np.outer(sin, x) + np.outer(cos, y)], -1)
    faces = turned * (sides * np.exp(log_scales) / FACE)[:, None, None]
    faces += (centres + shifts * sides[:, None])[:, None]
    boxes = np.concatenate([centres - sides[:, None] / 2, sides[:, None], sides[:, None]], 1)
    placement = measure_placement(boxes, faces, MEAN, FACE)
    spread = placement.spread
    assert placement.log_scale == pytest.approx(-0.2, abs=0.01)
    assert placement.shift == pytest.approx((0.05, -0.1), abs=0.01)
    assert spread.shift == pytest.approx((0.03, 0.06), abs=0.005)
    assert spread.log_scale == pytest.approx(0.09, abs=0.005)
    assert spread.rotation == pytest.approx(0.12, abs=0.005)
    centre, size = placement.face_in(np.array([100.0, 200.0, 50.0, 50.0]))
    np.testing.assert_allclose(centre, [125 + 0.05 * 50, 225 - 0.1 * 50], atol=0.5)
    assert size == pytest.approx(50 * np.exp(-0.2), rel=0.01)


def test_boxes_that_say_how_faces_are_turned_leave_no_rotation() -> None:
    """Shifts are along the face's axes, and go back into the picture with it."""
    rng = np.random.default_rng(0)
    rotations = rng.uniform(-180, 180, 50)
    cos, sin = np.cos(np.radians(rotations)), np.sin(np.radians(rotations))
    x, y = (MEAN + [6.0, -3.0]).T
    faces = np.stack([np.outer(cos, x) - np.outer(sin, y), np.outer(sin, x) + np.outer(cos, y)], -1) + 200
    boxes = np.tile([150.0, 150.0, 100.0, 100.0], (50, 1))
    placement = measure_placement(boxes, faces, MEAN, FACE, rotations)
    assert placement.shift == pytest.approx((0.06, -0.03), abs=1e-4)
    assert placement.spread.rotation == pytest.approx(0, abs=1e-4)
    for face, box, rotation in zip(faces, boxes, np.radians(rotations).tolist(), strict=True):
        centre, size = placement.face_in(box, rotation)
        np.testing.assert_allclose(centre, face.mean(0), atol=0.01)
        assert size == pytest.approx(FACE, abs=0.01)


def test_a_single_face_is_too_few() -> None:
    with pytest.raises(InputError, match="at least two faces"):
        measure_placement(np.array([[0.0, 0, 1, 1]]), MEAN[None], MEAN, FACE)
