"""The restricted camera: Eq. 15 against scipy's rotations, RQ against scipy's, and cameras of known projections."""

import jax
import numpy as np
import pytest
import scipy.linalg
from jax import numpy as jnp
from scipy.spatial.transform import Rotation

from jaxfit.shapes.camera import (
    Camera,
    align_shapes,
    in_plane,
    pose_degrees,
    pose_rotation,
    rotation_angles,
    rotation_matrix,
    rq,
    show,
    turn_in_plane,
)

RNG = np.random.default_rng(0)
HEAD = RNG.normal(0, 5, (9, 3))
EVERYWHERE = np.radians(np.stack([RNG.uniform(-180, 180, 40), RNG.uniform(-90, 90, 40), RNG.uniform(-180, 180, 40)], 1))
# Seen from behind, the rest has no direction in the picture.
AHEAD = np.radians(RNG.uniform(-75, 75, (40, 3)))

rotations = jax.jit(jax.vmap(rotation_matrix))
angles = jax.jit(jax.vmap(rotation_angles))
twists = jax.jit(jax.vmap(in_plane))
align = jax.jit(align_shapes)


def scipys(turns):
    """Eq. 15 by scipy: about the picture's z by -θ, then x by -γ, then y by η."""
    theta, gamma, eta = np.transpose(turns)
    return Rotation.from_euler("zxy", np.stack([-theta, -gamma, eta], 1)).as_matrix()


def seen(turn, scale=40.0, place=(320.0, 240.0), head=HEAD):
    """Where a head is seen, by scipy."""
    return scale * Rotation.from_rotvec(turn).apply(head)[:, :2] + place


def found(points, weights=None, head=HEAD):
    weights = np.ones(len(head)) if weights is None else weights
    return align(*(jnp.asarray(array, jnp.float32) for array in (head, points, weights)))


# Rotations and angles


def test_rotations_are_scipys():
    np.testing.assert_allclose(rotations(*jnp.float32(EVERYWHERE.T)), scipys(EVERYWHERE), atol=2e-6)


def test_the_first_two_rows_are_as_printed():
    ct, st, cg, sg, ce, se = (f(angle) for angle in EVERYWHERE.T for f in (np.cos, np.sin))
    printed = np.array([[ce * ct + se * sg * st, ce * st - se * sg * ct, se * cg], [-cg * st, cg * ct, sg]])
    found = rotations(*jnp.float32(EVERYWHERE.T))
    np.testing.assert_allclose(found[:, :2], np.moveaxis(printed, 2, 0), atol=2e-6)


def test_angles_undo_rotations():
    np.testing.assert_allclose(angles(rotations(*jnp.float32(EVERYWHERE.T))), EVERYWHERE, atol=2e-4)


def test_rotations_undo_angles():
    turns = Rotation.random(100, random_state=1).as_matrix()
    given = angles(jnp.float32(turns))
    np.testing.assert_allclose(rotations(*given.T), turns, atol=1e-5)
    assert (np.abs(given) <= np.pi * np.array([1, 0.5, 1]) + 1e-6).all()


@pytest.mark.parametrize("gamma", [-90.0, 90.0])
def test_heads_that_look_straight_up_or_down_keep_their_rotation(gamma):
    turns = np.radians([(theta, gamma, eta) for theta in (-100, 0, 40) for eta in (-170, 0, 30)])
    given = angles(jnp.float32(scipys(turns)))
    np.testing.assert_allclose(rotations(*given.T), scipys(turns), atol=1e-5)
    np.testing.assert_array_equal(given[:, 0], 0)
    np.testing.assert_allclose(given[:, 1], np.radians(gamma), atol=1e-6)


def test_angles_have_derivatives_where_the_head_looks_straight_ahead_up_and_down():
    turns = scipys([(0, gamma, 0) for gamma in np.radians([0, 90, -90])])
    assert np.isfinite(jax.jit(jax.vmap(jax.jacobian(rotation_angles)))(jnp.float32(turns))).all()


@pytest.mark.parametrize(
    ("angle", "axis", "moves"),
    [
        (0, [1.0, 0.0, 0.0], [0, 1]),  # roll: the picture's right sinks
        (1, [0.0, 0.0, -1.0], [0, -1]),  # pitch: the nose rises
        (2, [0.0, 0.0, -1.0], [-1, 0]),  # yaw: the nose goes left
    ],
    ids=["roll", "pitch", "yaw"],
)
def test_reported_angles_have_their_signs(angle, axis, moves):
    for sign in (1, -1):
        turn = np.zeros((1, 3))
        turn[0, angle] = sign * np.radians(30)
        reported = np.asarray(pose_degrees(*jnp.float32(turn[0])))
        assert abs(reported[angle]) == pytest.approx(30, abs=1e-4)
        assert np.delete(reported, angle) == pytest.approx(0)
        to = np.asarray(rotations(*jnp.float32(turn.T)))[0] @ axis
        assert (to - axis)[:2] @ moves == pytest.approx(np.sin(np.radians(reported[angle])), abs=1e-5)


def test_reported_poses_are_rotations():
    again = jax.jit(jax.vmap(lambda turn: pose_rotation(pose_degrees(*turn))))(jnp.float32(EVERYWHERE))
    np.testing.assert_allclose(again, scipys(EVERYWHERE), atol=2e-6)


# The turn in the picture


def test_the_turn_in_the_picture_adds_up():
    turns = jnp.float32(scipys(AHEAD))
    for angle in (0.0, 0.4, -2.0, 3.1):
        turn = np.asarray(turn_in_plane(jnp.float32(angle)))
        np.testing.assert_allclose(turn, Rotation.from_rotvec([0, 0, angle]).as_matrix(), atol=1e-6)
        before, after = map(np.asarray, (twists(turns), twists(turn @ np.asarray(turns))))
        np.testing.assert_allclose(np.exp(1j * after), np.exp(1j * (before + angle)), atol=1e-5)


def test_turns_about_an_axis_in_the_picture_are_none():
    axes = RNG.normal(size=(30, 3)) * [1, 1, 0]
    turns = axes / np.linalg.norm(axes, axis=1, keepdims=True) * RNG.uniform(-2.8, 2.8, (30, 1))
    np.testing.assert_allclose(twists(jnp.float32(Rotation.from_rotvec(turns).as_matrix())), 0, atol=1e-5)


def test_the_turn_of_a_head_seen_from_behind_is_finite():
    turn, slope = jax.jit(jax.value_and_grad(in_plane))(jnp.diag(jnp.array([-1.0, 1.0, -1.0])))
    assert float(turn) == 0
    assert np.isfinite(slope).all()


# RQ


def test_rq_is_scipys_with_positive_scales():
    matrices = RNG.normal(size=(20, 3, 3))
    for matrix, upper, orthogonal in zip(matrices, *jax.jit(jax.vmap(rq))(jnp.float32(matrices)), strict=True):
        scipys_upper, scipys_orthogonal = scipy.linalg.rq(matrix)
        signs = np.diag(np.sign(np.diag(scipys_upper)))
        np.testing.assert_allclose(upper, scipys_upper @ signs, atol=1e-4)
        np.testing.assert_allclose(orthogonal, signs @ scipys_orthogonal, atol=1e-4)
        assert (np.diag(upper) > 0).all()
        np.testing.assert_array_equal(np.tril(upper, -1), 0)


# Cameras


@pytest.mark.parametrize("weighted", [False, True])
def test_exact_projections_give_their_camera(weighted):
    for turn in Rotation.random(12, random_state=2).as_rotvec():
        weights = RNG.uniform(0.1, 3, 9) if weighted else np.ones(9)
        scale, place = RNG.uniform(0.5, 60), RNG.uniform(-300, 300, 2)
        camera = found(seen(turn, scale, place), weights)
        assert camera.ok
        assert camera.scale == pytest.approx(scale, rel=1e-4)
        np.testing.assert_allclose(camera.rotation, Rotation.from_rotvec(turn).as_matrix(), atol=1e-4)
        np.testing.assert_allclose(camera.place, place, atol=2e-2)


def test_a_head_need_not_be_centred():
    camera = found(seen([0.1, 0.5, -0.2], head=HEAD + 7), head=HEAD + 7)
    np.testing.assert_allclose(camera.place, [320, 240], atol=2e-2)
    np.testing.assert_allclose(
        show(jnp.float32(HEAD + 7), camera)[:, :2], seen([0.1, 0.5, -0.2], head=HEAD + 7), atol=1e-2
    )


@pytest.mark.parametrize("anything", [np.nan, np.inf, 1e30])
def test_unknown_points_may_be_anything(anything):
    known = np.arange(9) % 3 > 0
    points = seen([0.1, 0.5, -0.2])
    for one, other in zip(
        found(np.where(known[:, None], points, anything), known), found(points[known], head=HEAD[known]), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)


def test_the_camera_of_noisy_points_is_built_as_the_thesis_says():
    points, weights = seen([0.2, -0.4, 0.3]) + RNG.normal(0, 15, (9, 2)), RNG.uniform(0.5, 2, 9)
    middles = [np.average(array, axis=0, weights=weights) for array in (HEAD, points)]
    root = np.sqrt(weights)[:, None]
    general = np.linalg.lstsq(root * (HEAD - middles[0]), root * (points - middles[1]), rcond=None)[0].T
    upper, orthogonal = scipy.linalg.rq(np.stack([*general, np.cross(*general)]))
    signs = np.diag(np.sign(np.diag(upper)))
    scale = np.diag(upper @ signs)[:2].mean()
    camera = found(points, weights)
    assert camera.scale == pytest.approx(scale, rel=1e-4)
    np.testing.assert_allclose(camera.rotation, signs @ orthogonal, atol=1e-4)
    assert np.linalg.det(camera.rotation) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(camera.place, middles[1] - scale * (signs @ orthogonal @ middles[0])[:2], atol=1e-2)


POINTS = seen([0.1, 0.5, -0.2])
LINE = np.outer(np.arange(9), [3.0, 1.0]) + 100
PLANE = np.linalg.qr(RNG.normal(size=(3, 3)))[0][:2]
SOME = np.arange(9) < 3
DEGENERATE = {
    "one point": (HEAD, np.full((9, 2), 123.4), np.ones(9)),
    "on a line": (HEAD, LINE, np.ones(9)),
    "on a level line": (HEAD, LINE * [1, 0], np.ones(9)),
    "a planar head": (HEAD @ PLANE.T @ PLANE, seen([0.1, 0.5, -0.2], head=HEAD @ PLANE.T @ PLANE), np.ones(9)),
    "a straight head": (np.outer(np.arange(9), HEAD[0]), POINTS, np.ones(9)),
    "a head without size": (np.full((9, 3), 2.0), POINTS, np.ones(9)),
    "three points": (HEAD, np.where(SOME[:, None], POINTS, np.nan), SOME),
    "not numbers": (HEAD, np.where(SOME[:, None], POINTS, np.nan), np.ones(9)),
    "no numbers": (HEAD, np.full((9, 2), np.nan), np.ones(9)),
    "infinity": (HEAD, np.where(SOME[:, None], POINTS, np.inf), np.ones(9)),
    "nothing known": (HEAD, np.full((9, 2), np.nan), np.zeros(9)),
}
every_degenerate = pytest.mark.parametrize(("head", "points", "weights"), DEGENERATE.values(), ids=DEGENERATE)


@every_degenerate
def test_what_determines_no_camera(head, points, weights):
    camera = found(points, weights, head)
    assert not camera.ok
    np.testing.assert_array_equal(camera.rotation, np.eye(3))
    assert np.isfinite(camera.scale)
    assert np.isfinite(camera.place).all()


def test_four_points_are_enough():
    weights = np.arange(9) < 4
    camera = found(POINTS, weights)
    assert camera.ok
    np.testing.assert_allclose(camera.rotation, Rotation.from_rotvec([0.1, 0.5, -0.2]).as_matrix(), atol=1e-3)


def everything(head, points, weights):
    camera = align_shapes(head, points, weights)
    angles = rotation_angles(camera.rotation)
    return jnp.log(camera.scale) + (camera.place**2).sum() + (angles**2).sum() + (show(head, camera) ** 2).sum()


def test_derivatives_are_those_of_finite_differences():
    head, points, weights = (jnp.asarray(array, jnp.float32) for array in (HEAD, POINTS / 40, np.ones(9)))
    turned = jax.jit(lambda points: rotation_angles(align_shapes(head, points, weights).rotation))
    step = 0.02 * RNG.normal(size=(9, 2)).astype(np.float32)
    slope = jax.jit(lambda step: jax.jvp(turned, (points,), (step,))[1])(step)
    np.testing.assert_allclose(slope, (turned(points + step) - turned(points - step)) / 2, atol=1e-4)


def test_derivatives_are_finite_also_of_what_determines_no_camera():
    slopes = jax.jit(jax.grad(everything, (0, 1)))
    for head, points, weights in ((HEAD, POINTS, np.ones(9)), *DEGENERATE.values()):
        if np.isfinite(points).all():
            given = slopes(*(jnp.asarray(array, jnp.float32) for array in (head, points, weights)))
            assert all(np.isfinite(slope).all() for slope in given)


def test_many_are_each_alone():
    cases = [(HEAD, POINTS, np.ones(9)), *DEGENERATE.values()]
    stacked = (jnp.asarray(np.stack(arrays), jnp.float32) for arrays in zip(*cases, strict=True))
    many = jax.jit(jax.vmap(align_shapes))(*stacked)
    for number, (head, points, weights) in enumerate(cases):
        for one, all_of_them in zip(found(points, weights, head), many, strict=True):
            np.testing.assert_allclose(all_of_them[number], one, rtol=1e-4, atol=1e-4)


def test_what_is_shown_is_scaled_turned_and_placed():
    turn = Rotation.from_rotvec([0.3, 0.2, -0.9])
    camera = Camera(jnp.float32(3), jnp.float32(turn.as_matrix()), jnp.float32([5, -6]), jnp.array(True))
    np.testing.assert_allclose(show(jnp.float32(HEAD), camera), 3 * turn.apply(HEAD) + [5, -6, 0], atol=1e-4)
