"""Laws of the point space, and placing against scipy's rotations."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.spatial.transform import Rotation

from jaxfit.shapes.points import PointSpace, mean_face
from jaxfit.shapes.space import Start

FACES = np.random.default_rng(0).normal(40, 10, (8, 5, 2)).astype(np.float32)
SPACE = PointSpace(jnp.asarray(FACES[0] - FACES[0].mean(0)))


def start(scale=1.3, rotation=0.4):
    return Start(jnp.array([31.0, 52.0]), jnp.float32(scale), jnp.float32(rotation))


def params(number):
    return SPACE.encode(jnp.asarray(FACES[number]))


def test_parameters_are_the_landmarks():
    assert params(1).shape == (SPACE.size,)
    np.testing.assert_array_equal(SPACE.landmarks(params(1)), FACES[1])


@pytest.mark.parametrize(("here", "there"), [(1, 2), (3, 4), (5, 5)])
def test_the_difference_leads_to_the_target(here, there):
    step = SPACE.difference(params(there), params(here))
    np.testing.assert_allclose(SPACE.advance(params(here), step), params(there), atol=1e-4)


def test_the_difference_is_free_of_scale_and_place():
    step = SPACE.difference(params(1), params(2))
    larger = [SPACE.encode(jnp.asarray(3 * FACES[number] - 17)) for number in (1, 2)]
    np.testing.assert_allclose(SPACE.difference(*larger), step, atol=1e-4)


@pytest.mark.parametrize("rotation", [0.0, 0.3, -2.0])
@pytest.mark.parametrize("scale", [0.2, 1.0, 7.0])
def test_a_face_placed_at_a_scale_has_that_scale(scale, rotation):
    np.testing.assert_allclose(SPACE.scale(SPACE.place(start(scale, rotation))), scale, rtol=1e-5)


@pytest.mark.parametrize("rotation", [0.0, 0.4, np.pi / 2, -3.0])
def test_places_as_scipy_rotates(rotation):
    # About the z axis that points away from the viewer, x being right and y down: clockwise as seen.
    turned = Rotation.from_rotvec([0, 0, rotation]).apply(np.pad(np.asarray(SPACE.mean), ((0, 0), (0, 1))))[:, :2]
    placed = SPACE.landmarks(SPACE.place(start(1.3, rotation)))
    np.testing.assert_allclose(placed, 1.3 * turned + [31, 52], atol=1e-4)


def test_gradients_are_finite_where_all_points_coincide():
    together = SPACE.encode(jnp.full((5, 2), 20.0))

    def there_and_back(here, target):
        return (SPACE.difference(target, here) ** 2).sum() + (SPACE.advance(here, target) ** 2).sum()

    gradients = jax.jit(jax.grad(there_and_back, (0, 1)))
    for here, target in ((together, params(1)), (params(1), together), (together, together)):
        assert all(np.isfinite(gradient).all() for gradient in gradients(here, target))


def test_the_mean_face_is_centred_and_fills_its_square():
    mean = mean_face(FACES, 24.0)
    np.testing.assert_allclose(mean.mean(0), 0, atol=1e-5)
    assert np.ptp(mean, 0).max() == pytest.approx(24)


def test_the_mean_face_has_the_shape_of_the_mean():
    # Where the faces are and in which unit they are measured does not matter.
    np.testing.assert_allclose(mean_face(5 * FACES + [7, -3], 24.0), mean_face(FACES, 24.0), atol=1e-4)
    alone = mean_face(FACES[:1], 24.0)
    factor = np.ptp(FACES[0], 0).max() / 24
    np.testing.assert_allclose(factor * alone, FACES[0] - FACES[0].mean(0), atol=1e-4)
