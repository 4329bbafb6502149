"""Laws that every shape space keeps."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.spatial.transform import Rotation

from jaxfit.shapes import SPACES
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.points import PointSpace
from jaxfit.shapes.similarity import learn_similarity_asm
from jaxfit.shapes.space import ShapeSpace, ShapeSpace3D, Start

FACES = np.random.default_rng(0).normal(0, 30, (7, 2)) + np.random.default_rng(1).normal(0, 3, (40, 7, 2))
FACES = (FACES - FACES.mean(1, keepdims=True)).astype(np.float32)


def solid_model():
    """The faces' mean with depths, and two modes that do what no camera does."""
    rng = np.random.default_rng(2)
    mean = np.column_stack([FACES.mean(0), rng.normal(0, 30, 7)])
    mean -= mean.mean(0)
    moves = [*(np.broadcast_to(axis, mean.shape) for axis in np.eye(3)), *(np.cross(a, mean) for a in np.eye(3)), mean]
    given = np.concatenate([np.reshape(moves, (7, -1)), rng.normal(size=(2, mean.size))])
    modes = np.linalg.qr(given.T)[0].T[7:].reshape(2, 7, 3)
    return ActiveShapeModel(*(jnp.asarray(part, jnp.float32) for part in (mean, modes, [8.0, 5.0])))


MADE = {
    "points": PointSpace(jnp.asarray(FACES.mean(0))),
    "similarity-asm": learn_similarity_asm(jnp.asarray(FACES), 100.0, 0.9, 3.0),
    "camera-asm": CameraASM(solid_model(), jnp.float32(3.0)),
}
# Compiled once for each space; run as it is, an alternation compiles anew each time.
encode = jax.jit(lambda space, points: space.encode(points))
# Landmarks, scale and rotation.
seen = jax.jit(lambda space, params: (space.landmarks(params), space.scale(params), space.rotation(params)))
place = jax.jit(lambda space, start: space.place(start))
turn = jax.jit(lambda space, params, angle: space.turned(params, angle))
difference = jax.jit(lambda space, target, params: space.difference(target, params))
advance = jax.jit(lambda space, params, step: space.advance(params, step))
every_space = pytest.mark.parametrize("space", MADE.values(), ids=MADE)


def close(space, usual):
    """How near results must come to what they should be, in absolute terms: points are parameters without effort."""
    return {"atol": 1e-4 if isinstance(space, PointSpace) else usual}


def params(space, number):
    """A face as the space sees it, somewhere in a crop."""
    return encode(space, jnp.asarray(1.2 * FACES[number] + 80))


def turned(points, angle, offset=0.0):
    flat = np.pad(np.asarray(points), ((0, 0), (0, 1)))
    return Rotation.from_rotvec([0, 0, angle]).apply(flat)[:, :2] + offset


def test_no_space_is_left_out():
    assert MADE.keys() == SPACES.keys()


@every_space
def test_has_the_interface(space):
    assert isinstance(space, ShapeSpace)
    assert isinstance(space, ShapeSpace3D) == (space.dimensions == 3)
    assert params(space, 0).shape == (space.size,)


@every_space
def test_landmarks_in_3d_lie_where_those_of_the_picture_do(space):
    if not isinstance(space, ShapeSpace3D):
        pytest.skip("not in 3D")
    face = params(space, 2)
    np.testing.assert_allclose(space.landmarks_3d(face)[:, :2], seen(space, face)[0], atol=1e-4)
    assert space.b(face).shape == (space.modes,) == space.model.deviations.shape
    assert space.pose(face).shape == (3,)


@every_space
def test_encoding_undoes_landmarks(space):
    for number in range(5):
        there = params(space, number)
        np.testing.assert_allclose(encode(space, seen(space, there)[0]), there, **close(space, 2e-3))


@every_space
def test_the_difference_leads_to_the_target(space):
    for here, there in ((1, 2), (3, 4), (5, 5)):
        step = difference(space, params(space, there), params(space, here))
        found = advance(space, params(space, here), step)
        np.testing.assert_allclose(found, params(space, there), **close(space, 2e-3))


@every_space
def test_the_difference_is_free_of_scale_and_place(space):
    step = difference(space, params(space, 1), params(space, 2))
    larger = [encode(space, jnp.asarray(3.6 * FACES[number] - 17)) for number in (1, 2)]
    np.testing.assert_allclose(difference(space, *larger), step, **close(space, 2e-3))


@every_space
@pytest.mark.parametrize("rotation", [0.0, 0.4, np.pi / 2, -3.0])
@pytest.mark.parametrize("scale", [0.2, 1.0, 7.0])
def test_places_as_scipy_rotates(space, scale, rotation):
    # About the z axis that points away from the viewer, x being right and y down: clockwise as seen.
    mean, _, _ = seen(space, place(space, Start(jnp.zeros(2), jnp.ones(()), jnp.zeros(()))))
    placed = place(space, Start(jnp.array([31.0, 52.0]), jnp.float32(scale), jnp.float32(rotation)))
    points, size, angle = seen(space, placed)
    np.testing.assert_allclose(points, scale * turned(mean, rotation) + [31, 52], **close(space, 1e-3))
    np.testing.assert_allclose([size, angle], [scale, rotation], rtol=1e-4, atol=1e-5)


@every_space
@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0])
def test_turning(space, angle):
    face = place(space, Start(jnp.array([31.0, 52.0]), jnp.float32(1.3), jnp.float32(0.4)))
    points, scale, rotation = seen(space, turn(space, face, jnp.float32(angle)))
    np.testing.assert_allclose(points, turned(seen(space, face)[0], angle), atol=1e-3)
    assert np.exp(1j * float(rotation)) == pytest.approx(np.exp(1j * (0.4 + angle)), abs=1e-4)
    assert scale == pytest.approx(1.3, rel=1e-4)


@every_space
def test_derivatives_are_finite_also_where_all_points_coincide(space):
    together = encode(space, jnp.full((7, 2), jnp.float32(20)))
    if isinstance(space, CameraASM):
        together = together.at[-3:].set(0)  # the angles, which such points do not determine
    apart = params(space, 1)

    def everything(here, target):
        there = space.advance(here, space.difference(target, here))
        seen = space.landmarks(space.turned(there, -space.rotation(here)))
        total = (seen**2).sum() + space.scale(there)
        # The alternation takes as many rounds as it needs, and has no derivatives backwards.
        encoded = jnp.zeros(()) if isinstance(space, CameraASM) else space.encode(space.landmarks(here))
        return total + (encoded**2).sum()

    # Compiled without optimisation, which would take longer and changes nothing here.
    derivatives = jax.jit(jax.grad(everything, (0, 1)), compiler_options={"xla_backend_optimization_level": 0})
    for here, target in ((together, apart), (apart, together), (together, together)):
        assert all(np.isfinite(found).all() for found in derivatives(here, target))
