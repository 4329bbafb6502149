"""Alignment of a 3D shape model to landmarks: what exact projections, hidden points, noise and nonsense give."""

from functools import partial

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.spatial.transform import Rotation

from jaxfit.heads.model import load_head_model
from jaxfit.schemes.known import IBUG68
from jaxfit.shapes.alignment import align_head, refine_head
from jaxfit.shapes.asm import ActiveShapeModel

LANDMARKS, MODES = 20, 6


def random_model():
    """Random points, and orthonormal modes that neither move, turn nor scale them, nor so much as tend to."""
    rng = np.random.default_rng(0)
    mean = rng.normal(0, 5, (LANDMARKS, 3))
    mean -= mean.mean(0)
    moves = [*(np.broadcast_to(axis, mean.shape) for axis in np.eye(3)), *(np.cross(a, mean) for a in np.eye(3)), mean]
    given = np.concatenate([np.reshape(moves, (7, -1)), rng.normal(size=(MODES, mean.size))])
    modes = np.linalg.qr(given.T)[0].T[7:].reshape(MODES, LANDMARKS, 3)
    return ActiveShapeModel(*(jnp.asarray(part, jnp.float32) for part in (mean, modes, np.linspace(3, 1, MODES))))


MODEL, FACE = random_model(), load_head_model().of(IBUG68, 0.99)
models = pytest.mark.parametrize("model", [MODEL, FACE], ids=["random", "head"])

# A batch of faces: (N, L, 2) landmarks and (N, L) weights. The same N everywhere compiles once.
COUNT = 30
NOISE = 0.05  # of landmarks, in the unit of the model, centimetres


@partial(jax.jit, static_argnums=3)
def align_faces(model, points, weights, noise, most_rounds):
    return jax.vmap(partial(align_head, model, noise=noise, most_rounds=most_rounds))(points, weights)


def align(model, points, weights, noise=None, most_rounds=30):
    return align_faces(model, points, weights, noise, most_rounds)


# Compiled without optimisation, which would take longer than all else here.
refine = jax.jit(
    jax.vmap(partial(refine_head, noise=NOISE), (None, 0, 0, 0)),
    compiler_options={"xla_backend_optimization_level": 0},
)


def faces(model, seed=1):
    """Shapes (N, L, 3) of likely coefficients, where they are seen (N, L, 2), how turned, and their scales."""
    rng = np.random.default_rng(seed)
    shapes = of_coefficients(model, rng.normal(size=(COUNT, len(model.deviations))) * np.asarray(model.deviations))
    turns = Rotation.from_euler("zxy", rng.uniform([-60, -30, -50], [60, 30, 50], (COUNT, 3)), degrees=True)
    scales, places = rng.uniform(5, 20, (COUNT, 1, 1)), rng.uniform(-200, 200, (COUNT, 1, 2))
    seen = scales * np.einsum("nij,nlj->nli", turns.as_matrix(), shapes)[:, :, :2] + places
    return shapes, seen.astype(np.float32), turns, scales[:, 0, 0]


def noisy(points, scales, centimetres, seed=2):
    noise = np.random.default_rng(seed).normal(0, centimetres, points.shape)
    return (points + scales[:, None, None] * noise).astype(np.float32)


def everywhere(points):
    return np.ones(points.shape[:2], np.float32)


def of_coefficients(model, b):
    return np.asarray(model.mean) + np.tensordot(np.asarray(b), np.asarray(model.modes), 1)


def projections(model, found):
    """Where the camera of an alignment sees its shape, without jaxfit."""
    scale, rotation, place, _ = map(np.asarray, found.camera)
    seen = np.einsum("nij,nlj->nli", rotation, of_coefficients(model, found.b))[:, :, :2]
    return scale[:, None, None] * seen + place[:, None]


def shape_errors(model, found, shapes):
    """Mean distance of points, once turned, moved and scaled onto the true ones: a share of the face's extent."""
    errors = []
    for shape, true in zip(of_coefficients(model, found.b), shapes, strict=True):
        shape, true = shape - shape.mean(0), true - true.mean(0)
        turned = Rotation.align_vectors(true, shape)[0].apply(shape)
        turned *= np.sum(true * turned) / np.sum(turned**2)
        errors.append(np.linalg.norm(turned - true, axis=1).mean() / np.ptp(true, 0).max())
    return np.array(errors)


def turn_errors(found, turns):
    """Degrees between rotations."""
    return np.degrees((Rotation.from_matrix(np.asarray(found.camera.rotation, np.float64)).inv() * turns).magnitude())


def assert_same(one, other, **tolerance):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, **tolerance)


# What is recovered


@models
def test_exact_projections_give_pose_and_shape(model):
    shapes, points, turns, scales = faces(model)
    found = align(model, points, everywhere(points))
    assert found.camera.ok.all()
    assert turn_errors(found, turns).max() < 0.5
    assert shape_errors(model, found, shapes).max() < 0.01
    np.testing.assert_allclose(found.camera.scale, scales, rtol=0.02)
    # A look at the mean face is not enough.
    assert (found.rounds >= 1).all()
    assert np.median(found.rounds) <= 10


def test_without_noise_the_alignment_is_exact():
    shapes, points, turns, scales = faces(MODEL)
    found = align(MODEL, points, everywhere(points), noise=0.0)
    assert turn_errors(found, turns).max() < 0.05
    assert shape_errors(MODEL, found, shapes).max() < 1e-3
    np.testing.assert_allclose(found.camera.scale, scales, rtol=1e-3)
    np.testing.assert_allclose(found.error / scales, 0, atol=0.02)


def test_the_error_is_the_sum_of_distances():
    _, points, _, scales = faces(MODEL)
    points = noisy(points, scales, 0.5)
    weights = np.random.default_rng(3).uniform(0, 2, points.shape[:2]).astype(np.float32)
    found = align(MODEL, points, weights)
    distances = np.linalg.norm(projections(MODEL, found) - points, axis=2)
    np.testing.assert_allclose(found.error, (weights * distances).sum(1), rtol=1e-3)


def test_landmarks_that_err_are_not_explained_by_unlikely_shapes():
    shapes, points, turns, scales = faces(FACE)
    points = noisy(points, scales, 0.15)
    weighed, trusted = (align(FACE, points, everywhere(points), noise=noise) for noise in (None, 0.0))
    assert shape_errors(FACE, weighed, shapes).mean() < 0.8 * shape_errors(FACE, trusted, shapes).mean()
    assert np.median(turn_errors(weighed, turns)) < np.median(turn_errors(trusted, turns))
    sizes = [np.linalg.norm(found.b / FACE.deviations, axis=1) for found in (weighed, trusted)]
    assert (sizes[0] < sizes[1]).all()


@models
def test_unknown_landmarks_say_nothing(model):
    shapes, points, turns, _ = faces(model)
    known = np.random.default_rng(5).random(points.shape[:2]) < 0.8
    hidden, weights = np.where(known[..., None], points, np.float32(np.nan)), known.astype(np.float32)
    found = align(model, hidden, weights)
    assert_same(found, align(model, points, weights))
    assert found.camera.ok.all()
    assert np.median(turn_errors(found, turns)) < 0.5
    assert np.median(shape_errors(model, found, shapes)) < 0.01


def test_one_face_is_as_one_of_many_and_without_weights_all_landmarks_count_alike():
    _, points, _, scales = faces(MODEL)
    points = noisy(points, scales, 0.3)
    many, alone = align(MODEL, points, everywhere(points)), jax.jit(align_head)
    for number in range(5):
        one = alone(MODEL, jnp.asarray(points[number]))
        of_many = jax.tree.map(lambda array, number=number: array[number], many)
        assert_same((one.b, one.camera), (of_many.b, of_many.camera), rtol=1e-2, atol=1e-2)


# Rounds


def test_the_error_never_rises():
    _, points, _, scales = faces(MODEL)
    points, errors = noisy(points, scales, 0.05), []
    for rounds in (1, 2, 30):
        found = align(MODEL, points, everywhere(points), most_rounds=rounds)
        assert (found.rounds <= rounds).all()
        errors.append(np.asarray(found.error))
    assert (np.diff(errors, axis=0) <= 1e-4 * errors[0]).all()
    assert (errors[-1] < 0.9 * errors[0]).mean() > 0.5


# What determines nothing


def degenerate():
    """Landmarks and weights that determine no camera."""
    _, points, _, _ = faces(MODEL)
    few = np.arange(LANDMARKS) < 3
    cases = {
        "one point": (np.full((LANDMARKS, 2), 50.0), np.ones(LANDMARKS)),
        "on a line": (np.outer(np.arange(LANDMARKS), [3, 2]), np.ones(LANDMARKS)),
        "few points": (np.where(few[:, None], points[0], np.nan), few),
        "nothing known": (np.full((LANDMARKS, 2), np.nan), np.zeros(LANDMARKS)),
        "not numbers": (np.where(few[:, None], points[0], np.nan), np.ones(LANDMARKS)),
    }
    return [np.stack(arrays).astype(np.float32) for arrays in zip(*cases.values(), strict=True)]


def test_landmarks_that_determine_nothing_have_no_alignment_and_do_no_harm_to_others():
    _, points, _, _ = faces(MODEL)
    weights = everywhere(points)
    others = align(MODEL, points, weights)
    points[:5], weights[:5] = degenerate()
    found = align(MODEL, points, weights)
    np.testing.assert_array_equal(found.camera.ok, np.arange(COUNT) >= 5)
    assert_same(*(jax.tree.map(lambda array: array[5:], one) for one in (found, others)))
    np.testing.assert_array_equal(found.b[:5], 0)
    np.testing.assert_array_equal(found.rounds[:5], 0)
    np.testing.assert_array_equal(found.camera.rotation[:5], np.broadcast_to(np.eye(3), (5, 3, 3)))
    assert all(np.isfinite(array).all() for array in jax.tree.leaves((found.b, found.camera)))
    assert np.isfinite(found.error[:4]).all()  # the distances from what is no number are none either
    refined = refine(MODEL, points, found, weights)
    assert_same(*(jax.tree.map(lambda array: array[:5], one) for one in (refined, found)))


# Refinement


def penalised(points, found, start):
    """What refinement lowers: squared distances over the noise's, and b's prior."""
    squares = np.sum((projections(MODEL, found) - points) ** 2, (1, 2)) / np.asarray(start.camera.scale) ** 2
    return squares / NOISE**2 + np.sum((np.asarray(found.b) / np.asarray(MODEL.deviations)) ** 2, 1)


def perturbed(found, seed):
    """An alignment, its head turned by some 6 degrees, larger by 5 % and of another shape."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(0, 0.06, (COUNT, 3))).as_matrix()
    rotation = jnp.asarray(turn @ np.asarray(found.camera.rotation), jnp.float32)
    change = rng.normal(0, 0.5, found.b.shape) * np.asarray(MODEL.deviations)
    camera = found.camera._replace(rotation=rotation, scale=found.camera.scale * 1.05)
    return found._replace(b=found.b + jnp.asarray(change, jnp.float32), camera=camera)


def test_refinement_lowers_what_it_minimises_and_brings_the_truth_nearer():
    shapes, points, turns, scales = faces(MODEL)
    points = noisy(points, scales, 0.05)
    start = perturbed(align(MODEL, points, everywhere(points)), seed=8)
    found = refine(MODEL, points, start, everywhere(points))
    assert (penalised(points, found, start) < penalised(points, start, start)).all()
    assert np.median(turn_errors(found, turns)) < 0.5 * np.median(turn_errors(start, turns))
    assert np.median(shape_errors(MODEL, found, shapes)) < 0.7 * np.median(shape_errors(MODEL, start, shapes))
    rotation = np.asarray(found.camera.rotation)
    unit = np.broadcast_to(np.eye(3), rotation.shape)
    np.testing.assert_allclose(rotation @ np.moveaxis(rotation, 1, 2), unit, atol=1e-5)
    np.testing.assert_array_equal(found.rounds, start.rounds)
    distances = np.linalg.norm(projections(MODEL, found) - points, axis=2)
    np.testing.assert_allclose(found.error, distances.sum(1), rtol=1e-3)


def test_refinement_keeps_what_it_cannot_better():
    _, points, _, _ = faces(MODEL)
    start = align(MODEL, points, everywhere(points))
    found = refine(MODEL, points, start, everywhere(points))
    assert (penalised(points, found, start) <= penalised(points, start, start) + 1e-2).all()


def test_refinement_does_not_look_at_unknown_landmarks():
    _, points, _, _ = faces(MODEL)
    weights = (np.random.default_rng(9).random(points.shape[:2]) < 0.8).astype(np.float32)
    start = perturbed(align(MODEL, points, weights), seed=10)
    hidden = np.where(weights[..., None] > 0, points, np.float32(np.nan))
    assert_same(refine(MODEL, hidden, start, weights), refine(MODEL, points, start, weights))
