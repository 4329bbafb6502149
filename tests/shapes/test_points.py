"""What is the point space's own, beside the laws of all spaces: its parameters, its scale, the mean face."""

import numpy as np
import pytest
from jax import numpy as jnp

from jaxfit.shapes.points import PointSpace, mean_face
from jaxfit.shapes.space import Start

FACES = np.random.default_rng(0).normal(40, 10, (8, 5, 2)).astype(np.float32)
SPACE = PointSpace(jnp.asarray(FACES[0] - FACES[0].mean(0)))


def params(number):
    return SPACE.encode(jnp.asarray(FACES[number]))


def test_parameters_are_the_landmarks():
    assert params(1).shape == (SPACE.size,)
    np.testing.assert_array_equal(SPACE.landmarks(params(1)), FACES[1])


@pytest.mark.parametrize("rotation", [0.0, 0.3, -2.0])
@pytest.mark.parametrize("scale", [0.2, 1.0, 7.0])
def test_a_face_placed_at_a_scale_has_that_scale(scale, rotation):
    start = Start(jnp.array([31.0, 52.0]), jnp.float32(scale), jnp.float32(rotation))
    np.testing.assert_allclose(SPACE.scale(SPACE.place(start)), scale, rtol=1e-5)


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
