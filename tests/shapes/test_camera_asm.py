"""The 3D methods' shape space: exact faces come back, heads turn as pictures do, and poses have their signs."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="misc"

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.spatial.transform import Rotation

from jaxfit.heads.model import load_head_model
from jaxfit.schemes.known import AFLW21
from jaxfit.shapes.camera import align_shapes, show
from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.space import Start, rotate

NOSE, LEFT_EYE, RIGHT_EYE = 14, *AFLW21.outer_eyes
COUNT = 20  # faces, everywhere: one number of them compiles once


SPACE = CameraASM(load_head_model().of(AFLW21, 0.9), jnp.float32(3.0))
MODES = SPACE.size - 6

landmarks = jax.jit(jax.vmap(SPACE.landmarks))
landmarks_3d = jax.jit(jax.vmap(SPACE.landmarks_3d))
rotation = jax.jit(jax.vmap(SPACE.rotation))
turn = jax.jit(jax.vmap(SPACE.turned, (0, None)))
encode = jax.jit(jax.vmap(SPACE.encode))
pose = jax.jit(jax.vmap(SPACE.pose))
difference = jax.jit(jax.vmap(SPACE.difference))
advance = jax.jit(jax.vmap(SPACE.advance))


def faces(most_pitch=75, most_yaw=75, seed=0):
    """Parameters (N, P) of likely shapes, in any roll."""
    rng = np.random.default_rng(seed)
    b = rng.normal(size=(COUNT, MODES))
    b *= np.minimum(1, 2.5 / np.linalg.norm(b, axis=1, keepdims=True)) * np.asarray(SPACE.model.deviations)
    angles = np.radians(rng.uniform([-180, -most_pitch, -most_yaw], [180, most_pitch, most_yaw], (COUNT, 3)))
    scales, places = rng.uniform(3, 12, (COUNT, 1)), rng.uniform(-50, 150, (COUNT, 2))
    return np.concatenate([b, scales, places, angles], 1).astype(np.float32)


def head(roll=0.0, pitch=0.0, yaw=0.0):
    """The parameters (N, P) of N times the mean head in a reported pose, in degrees."""
    angles = np.radians([-roll, pitch, yaw])
    return np.tile(np.concatenate([np.zeros(MODES), [5, 80, 60], angles]).astype(np.float32), (COUNT, 1))


def test_landmarks_are_shape_camera_and_place():
    params = faces()
    for one, seen, solid in zip(params, landmarks(params), landmarks_3d(params), strict=True):
        b, (s, *place, theta, gamma, eta) = one[:MODES], one[MODES:].astype(float)
        shape = np.asarray(SPACE.model.mean) + np.tensordot(b, np.asarray(SPACE.model.modes), 1)
        turned = s * Rotation.from_euler("zxy", [-theta, -gamma, eta]).apply(shape)
        np.testing.assert_allclose(seen, turned[:, :2] + place, atol=1e-3)
        np.testing.assert_allclose(solid, turned + [*place, 0], atol=1e-3)


def test_encoding_undoes_landmarks():
    params = faces(most_pitch=30, most_yaw=50)
    found = np.asarray(encode(landmarks(params)))
    sizes = params[:, MODES, None]
    np.testing.assert_allclose(found[:, MODES] / sizes[:, 0], 1, atol=0.01)
    np.testing.assert_allclose((found - params)[:, MODES + 1 : -3] / sizes, 0, atol=0.1)  # 1 mm
    assert np.abs((np.asarray(pose(found) - pose(params)) + 180) % 360 - 180).max() < 2
    assert np.median(np.abs(found - params)[:, :MODES] / np.asarray(SPACE.model.deviations)) < 0.05
    assert np.linalg.norm(landmarks(found) - landmarks(params), axis=2).max() < 0.05 * params[:, MODES].max()


def test_encoding_keeps_b_in_the_ellipsoid():
    params = faces()
    params[:, :MODES] *= 6
    b = np.asarray(encode(landmarks(params)))[:, :MODES] / np.asarray(SPACE.model.deviations)
    norms = np.linalg.norm(b, axis=1)
    assert norms.max() <= 3 + 1e-4
    assert (norms > 2.99).any()


def test_refined_parameters_fit_better():
    params = faces(most_pitch=30, most_yaw=50)
    params[:, :MODES] /= 2
    seen = np.asarray(landmarks(params))
    errors = 0.1 * params[:, MODES, None, None] * np.random.default_rng(1).normal(size=seen.shape)
    points = (seen + errors).astype(np.float32)
    # Compiled without optimisation, which would take longer than all else here.
    fast = {"xla_backend_optimization_level": 0}
    refine = jax.jit(jax.vmap(SPACE.refined), compiler_options=fast)
    plain, refined = encode(points), refine(points)
    squares, priors = [], []
    for found in (plain, refined):
        squares.append(((landmarks(found) - points) ** 2).sum((1, 2)))
        priors.append(((found[:, :MODES] / SPACE.model.deviations) ** 2).sum(1))
    assert max(map(np.max, priors)) < 3**2  # the ellipsoid takes nothing back
    costs = [square / squares[0] * points[0].size + prior for square, prior in zip(squares, priors, strict=True)]
    assert (costs[1] <= costs[0] + 1e-2).all()
    assert (costs[1] < costs[0] - 1e-2).mean() > 0.5


def test_coefficients_outside_the_ellipsoid_are_pulled_back_and_the_camera_is_the_best_for_them():
    b = 3 * SPACE.sigmas * SPACE.model.deviations / jnp.sqrt(float(MODES))
    points = 5 * SPACE.model.reconstruct(b)[:, :2] + 20
    params = encode(jnp.tile(points, (COUNT, 1, 1)))
    inside = params[0, :MODES]
    assert jnp.linalg.norm(inside / SPACE.model.deviations) <= SPACE.sigmas * 1.001
    best = jax.jit(align_shapes)(SPACE.model.reconstruct(inside), points, jnp.ones(len(points)))
    np.testing.assert_allclose(params[0, MODES], best.scale, rtol=1e-4)
    np.testing.assert_allclose(landmarks(params)[0], show(SPACE.model.reconstruct(inside), best)[:, :2], atol=1e-2)


def test_landmarks_on_a_line_tell_no_angles():
    params = faces()
    on_a_line = np.asarray(landmarks(params)) * [1.0, 0.0] + 40
    found = np.asarray(encode(on_a_line.astype(np.float32)))
    assert np.isnan(found[:, -3:]).all()
    assert np.isfinite(found[:, :-3]).all()


@pytest.mark.parametrize("angle", [0.0, 0.6, -2.5])
def test_turning_the_head_turns_the_picture(angle):
    params = faces()
    found = turn(params, jnp.float32(angle))
    np.testing.assert_allclose(landmarks(found), rotate(landmarks(params), jnp.float32(angle)), atol=2e-3)
    turned = np.asarray(rotation(found)) - np.asarray(rotation(params)) - angle
    np.testing.assert_allclose(np.exp(1j * turned), 1, atol=1e-4)
    np.testing.assert_array_equal(found[:, : MODES + 1], params[:, : MODES + 1])
    # In depth, too, nothing but the picture turns.
    np.testing.assert_allclose(landmarks_3d(found)[:, :, 2], landmarks_3d(params)[:, :, 2], atol=2e-3)
    if not angle:
        np.testing.assert_array_equal(found, params)


def test_upright_heads_are_not_turned():
    poses = [{"pitch": pitch} for pitch in (-60, 0, 45)] + [{"yaw": yaw} for yaw in (-80, 0, 60)]
    params = np.resize([head(**pose)[0] for pose in poses], (COUNT, SPACE.size))
    np.testing.assert_allclose(rotation(params), 0, atol=1e-5)
    np.testing.assert_allclose(rotation(head(roll=25)), np.radians(25), atol=1e-5)


@pytest.mark.parametrize("degrees", [5, 30, 60])
@pytest.mark.parametrize("sign", [1, -1])
def test_poses_have_their_signs(degrees, sign):
    ahead = np.asarray(landmarks(head()))[0]
    for angle in ("roll", "pitch", "yaw"):
        params = head(**{angle: sign * degrees})
        reported = dict.fromkeys(("roll", "pitch", "yaw"), 0.0) | {angle: sign * degrees}
        np.testing.assert_allclose(pose(params)[0], list(reported.values()), atol=1e-3)
        seen = np.asarray(landmarks(params))[0]
        if angle == "roll":  # clockwise: the right eye sinks
            x, y = seen[RIGHT_EYE] - seen[LEFT_EYE]
            assert np.degrees(np.arctan2(y, x)) == pytest.approx(sign * degrees, abs=0.5)
        else:  # up is towards smaller y, and yaw > 0 towards smaller x
            axis = {"pitch": 1, "yaw": 0}[angle]
            assert sign * (seen - ahead)[NOSE, axis] < 0


def test_poses_are_those_of_the_rotation_also_beyond_half_turns():
    params = faces()
    params[:, -3] += 2 * np.pi * np.arange(COUNT).astype(np.float32)
    np.testing.assert_allclose(landmarks(turn(params, jnp.float32(0.0))), landmarks(params))
    step = difference(params, faces())
    np.testing.assert_allclose(step, 0, atol=2e-4)


def test_advancing_by_the_difference_reaches_the_target():
    here, there = faces(seed=1), faces(seed=2)
    np.testing.assert_allclose(advance(here, difference(there, here)), there, atol=2e-4)


def test_differences_are_the_shorter_way_round_and_free_of_scale():
    step = np.asarray(difference(head(roll=170), head(roll=-170)))[0]
    assert np.degrees(step[-3]) == pytest.approx(20, abs=1e-3)  # θ is counter-clockwise
    here, there = faces(seed=1), faces(seed=2)
    grown = [params.copy() for params in (there, here)]
    for params in grown:
        params[:, MODES : MODES + 3] *= 3
    np.testing.assert_allclose(difference(*grown), difference(there, here), rtol=1e-4, atol=1e-4)


def test_steps_too_far_are_pulled_back_into_the_ellipsoid():
    advanced = np.asarray(advance(head(), np.full((COUNT, SPACE.size), 50, np.float32)))[0]
    assert np.linalg.norm(advanced[:MODES] / np.asarray(SPACE.model.deviations)) == pytest.approx(3, abs=1e-4)
    assert np.abs(advanced[-3:]).max() <= np.pi + 1e-6


def test_a_start_is_the_mean_face_from_the_front():
    start = Start(jnp.array([31.0, 52.0]), jnp.float32(4.0), jnp.float32(0.3))
    params = SPACE.place(start)
    np.testing.assert_array_equal(SPACE.b(params), 0)
    np.testing.assert_allclose(SPACE.pose(params), [np.degrees(0.3), 0, 0], atol=1e-4)
    assert float(SPACE.scale(params)) == 4.0
    np.testing.assert_allclose(params[MODES + 1 : -3], [31, 52])
