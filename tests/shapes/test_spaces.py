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
from jaxfit.shapes.space import ShapeSpace, Start

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
# Run as it is, an alternation compiles anew each time.
encode = jax.jit(lambda space, points: space.encode(points))
every_space = pytest.mark.parametrize("space", MADE.values(), ids=MADE)


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
    assert params(space, 0).shape == (space.size,)


@every_space
def test_encoding_undoes_landmarks(space):
    for number in range(5):
        there = params(space, number)
        np.testing.assert_allclose(encode(space, space.landmarks(there)), there, atol=2e-3)


@every_space
def test_the_difference_leads_to_the_target(space):
    for here, there in ((1, 2), (3, 4), (5, 5)):
        step = space.difference(params(space, there), params(space, here))
        np.testing.assert_allclose(space.advance(params(space, here), step), params(space, there), atol=2e-3)


@every_space
def test_the_difference_is_free_of_scale_and_place(space):
    step = space.difference(params(space, 1), params(space, 2))
    larger = [encode(space, jnp.asarray(3.6 * FACES[number] - 17)) for number in (1, 2)]
    np.testing.assert_allclose(space.difference(*larger), step, atol=2e-3)


@every_space
@pytest.mark.parametrize("rotation", [0.0, 0.4, np.pi / 2, -3.0])
@pytest.mark.parametrize("scale", [0.2, 1.0, 7.0])
def test_places_as_scipy_rotates(space, scale, rotation):
    # About the z axis that points away from the viewer, x being right and y down: clockwise as seen.
    mean = space.landmarks(space.place(Start(jnp.zeros(2), jnp.ones(()), jnp.zeros(()))))
    placed = space.place(Start(jnp.array([31.0, 52.0]), jnp.float32(scale), jnp.float32(rotation)))
    np.testing.assert_allclose(space.landmarks(placed), scale * turned(mean, rotation) + [31, 52], atol=1e-3)
    np.testing.assert_allclose([space.scale(placed), space.rotation(placed)], [scale, rotation], rtol=1e-4, atol=1e-5)


@every_space
@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0])
def test_turning(space, angle):
    face = space.place(Start(jnp.array([31.0, 52.0]), jnp.float32(1.3), jnp.float32(0.4)))
    result = space.turned(face, jnp.float32(angle))
    np.testing.assert_allclose(space.landmarks(result), turned(space.landmarks(face), angle), atol=1e-3)
    assert np.exp(1j * float(space.rotation(result))) == pytest.approx(np.exp(1j * (0.4 + angle)), abs=1e-4)
    assert space.scale(result) == pytest.approx(1.3, rel=1e-4)


@every_space
def test_derivatives_are_finite_also_where_all_points_coincide(space):
    together = encode(space, jnp.full((7, 2), 20.0))
    apart = params(space, 1)

    def everything(here, target):
        there = space.advance(here, space.difference(target, here))
        seen = space.landmarks(space.turned(there, -space.rotation(here)))
        total = (seen**2).sum() + space.scale(there)
        # The alternation takes as many rounds as it needs, and has no derivatives backwards.
        encoded = jnp.zeros(()) if isinstance(space, CameraASM) else space.encode(space.landmarks(here))
        return total + (encoded**2).sum()

    derivatives = jax.jit(jax.grad(everything, (0, 1)))
    for here, target in ((together, apart), (apart, together), (together, together)):
        assert all(np.isfinite(found).all() for found in derivatives(here, target))
