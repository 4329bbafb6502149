"""Alignment, of one face and of many: against general least squares and scipy's orthogonal Procrustes."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.linalg import orthogonal_procrustes
from scipy.spatial.transform import Rotation

from jaxfit.shapes.points import PointSpace
from jaxfit.shapes.procrustes import align_similarity, generalised_procrustes
from jaxfit.shapes.space import Start, rotate

MEAN = np.random.default_rng(0).normal(0, 10, (7, 2))
MEAN -= MEAN.mean(0)
align = jax.jit(lambda points: align_similarity(points, jnp.asarray(MEAN, jnp.float32)))


def least_squares(points):
    """Centre, scale and rotation by linear least squares: x' = a x − b y + c, y' = b x + a y + d."""
    (x, y), one, zero = MEAN.T, np.ones(len(MEAN)), np.zeros(len(MEAN))
    matrix = np.concatenate([np.stack([x, -y, one, zero], 1), np.stack([y, x, zero, one], 1)])
    a, b, c, d = np.linalg.lstsq(matrix, points.T.reshape(-1), rcond=None)[0]
    return [c, d], np.hypot(a, b), np.arctan2(b, a)


@pytest.mark.parametrize("seed", range(5))
def test_is_the_least_squares_similarity(seed):
    # Unrelated points and mirror images too, where Procrustes without a condition would reflect.
    points = np.random.default_rng(seed).normal(50, 12, MEAN.shape) if seed else MEAN * [-1, 1] + 50
    found = align(points.astype(np.float32))
    for value, expected in zip(found, least_squares(points), strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-3)


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_agrees_with_scipys_procrustes(noise):
    turn = np.array([[np.cos(0.7), np.sin(0.7)], [-np.sin(0.7), np.cos(0.7)]])
    points = 1.7 * MEAN @ turn + [30, 60] + noise * np.random.default_rng(1).normal(size=MEAN.shape)
    rotation, singular_values = orthogonal_procrustes(MEAN, points - points.mean(0))
    found = align(points.astype(np.float32))
    np.testing.assert_allclose(found.centre, points.mean(0), atol=1e-3)
    np.testing.assert_allclose(found.scale, singular_values / (MEAN**2).sum(), atol=1e-4)
    np.testing.assert_allclose(found.rotation, np.arctan2(rotation[0, 1], rotation[0, 0]), atol=1e-4)


@pytest.mark.parametrize("rotation", [0.0, 1.2, -3.0, 3.1])
@pytest.mark.parametrize("scale", [0.1, 4.0])
def test_undoes_placing(scale, rotation):
    space = PointSpace(jnp.asarray(MEAN, jnp.float32))
    start = Start(jnp.array([-5.0, 70.0]), jnp.float32(scale), jnp.float32(rotation))
    for found, expected in zip(align(space.landmarks(space.place(start))), start, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)


def random_faces(dimensions, noise=0.1, count=30):
    rng = np.random.default_rng(dimensions)
    mean = rng.normal(size=(6, dimensions))
    return mean + noise * rng.normal(size=(count, 6, dimensions))


def random_similarities(faces, seed=0):
    """Each face moved, scaled and turned by its own."""
    rng = np.random.default_rng(seed)
    dimensions = faces.shape[-1]
    turns = Rotation.random(len(faces), random_state=seed).as_matrix() if dimensions == 3 else planar(rng, len(faces))
    scales = np.exp(rng.normal(size=(len(faces), 1, 1)))
    return scales * faces @ turns + rng.normal(0, 5, (len(faces), 1, dimensions))


def planar(rng, count):
    return Rotation.from_rotvec(rng.uniform(-np.pi, np.pi, (count, 1)) * [0, 0, 1]).as_matrix()[:, :2, :2]


def procrustes(faces, tolerance=1e-6, most_rounds=100):
    # All arguments, and 30 faces everywhere: compiled once in each number of dimensions.
    return generalised_procrustes(jnp.asarray(faces, jnp.float32), tolerance, most_rounds)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_generalised_does_not_depend_on_where_faces_lie(dimensions):
    plain = procrustes(random_faces(dimensions))
    moved = procrustes(random_similarities(random_faces(dimensions)))
    assert plain.converged
    assert moved.converged
    # The mean is turned as the faces lie on average; its shape does not depend on that.
    rotation, _ = orthogonal_procrustes(np.asarray(moved.mean), np.asarray(plain.mean))
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-4)
    np.testing.assert_allclose(moved.mean @ rotation, plain.mean, atol=1e-4)
    np.testing.assert_allclose(moved.aligned @ rotation, plain.aligned, atol=1e-3)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_generalised_brings_equal_faces_together(dimensions):
    faces = random_similarities(np.repeat(random_faces(dimensions)[:1], 30, 0))
    found = procrustes(faces)
    np.testing.assert_allclose(found.aligned, np.broadcast_to(found.mean, faces.shape), atol=1e-4)
    assert int(found.rounds) <= 3


@pytest.mark.parametrize("dimensions", [2, 3])
def test_generalised_is_a_fixed_point_of_plain_alternation(dimensions):
    faces = random_similarities(random_faces(dimensions))
    mean = np.asarray(procrustes(faces).mean, np.float64)
    assert mean.mean(0) == pytest.approx(0, abs=1e-5)
    assert np.sqrt((mean**2).sum(1).mean()) == pytest.approx(1, abs=1e-5)
    aligned = []
    for face in faces - faces.mean(1, keepdims=True):
        rotation, _ = orthogonal_procrustes(face, mean)
        turned = face @ rotation
        aligned.append(turned * (mean**2).sum() / (turned * mean).sum())
    again = np.mean(aligned, 0)
    again /= np.sqrt((again**2).sum(1).mean())
    np.testing.assert_allclose(again, mean, atol=1e-4)


def test_generalised_in_the_plane_aligns_as_the_similarity_does():
    faces = random_faces(2)
    found = procrustes(faces)
    start = jax.vmap(align_similarity, (0, None))(jnp.asarray(faces, jnp.float32), found.mean)
    space = PointSpace(found.mean)
    placed = jax.vmap(lambda start: space.landmarks(space.place(start)))(start)
    left = jax.vmap(rotate)(jnp.asarray(faces, jnp.float32) - placed, -start.rotation) / start.scale[:, None, None]
    np.testing.assert_allclose(found.aligned - found.mean, left, atol=1e-4)


def test_the_mean_lies_as_the_faces_do_on_average():
    faces = random_faces(2)
    turn = Rotation.from_rotvec([0, 0, 0.6]).as_matrix()[:2, :2].T
    np.testing.assert_allclose(procrustes(faces @ turn).mean, procrustes(faces).mean @ turn, atol=1e-4)
    np.testing.assert_allclose(
        align_similarity(jnp.asarray(faces.mean(0), jnp.float32), procrustes(faces).mean).rotation, 0, atol=1e-3
    )


def test_it_says_when_it_has_not_converged():
    faces = random_faces(2, noise=0.8)
    assert not procrustes(faces, most_rounds=1).converged
    assert int(procrustes(faces, most_rounds=1).rounds) == 1
    assert not procrustes(faces, tolerance=0.0, most_rounds=5).converged
    assert procrustes(faces).converged


def test_a_face_without_size_does_no_harm():
    faces = random_faces(2)
    faces[3] = 7.0
    assert np.isfinite(procrustes(faces).aligned).all()


def test_reflections_are_not_rotations():
    faces = random_faces(2, noise=0.0)
    mirrored = faces[0] * [-1, 1]
    found = procrustes(np.stack([faces[0]] * 29 + [mirrored]))
    assert np.abs(found.aligned[-1] - found.mean).max() > 0.1
