"""Fitting: a plain loop, one face against batches, several starts against brute force, derivatives; heads in 3D."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from blobs import FRAME, MEAN, SPACE, Patch, blob_faces, shape_model_space
from jax import numpy as jnp
from scipy.spatial.transform import Rotation

from jaxfit.cascade.fit import centroid, find, fit_crops, fit_face, fit_heads, fit_starts
from jaxfit.cascade.model import Cascade, Hidden, Regressor, first_steps
from jaxfit.cascade.starts import Starts, starts_of
from jaxfit.descriptors.descriptor import describe_point
from jaxfit.descriptors.sift import Sift
from jaxfit.errors import InputError
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.points import PointSpace
from jaxfit.shapes.space import Start

CROPS, _ = blob_faces(4, seed=0)
SEVERAL = Starts(5, -50.0, 40.0)
ASM = shape_model_space(blob_faces(40, seed=3)[1])
spaces = pytest.mark.parametrize("space", [SPACE, ASM], ids=["points", "asm"])


def turned_by(degrees):
    """A single start."""
    return Starts(1, degrees, degrees)


def random_cascade(descriptor=None, strength=0.7, steps=3):
    descriptor = descriptor or Patch()
    rng = np.random.default_rng(0)
    return Cascade(
        space=SPACE,
        weights=tuple(jnp.asarray(strength * rng.normal(size=(steps, 4 * descriptor.size, SPACE.size)), jnp.float32)),
        biases=jnp.asarray(strength * rng.normal(size=(steps, SPACE.size)), jnp.float32),
        windows=jnp.asarray(np.linspace(16, 8, steps), jnp.float32),
        descriptor=descriptor,
        frame=FRAME,
    )


CASCADE = random_cascade()
START = SPACE.place(Start(jnp.array([22.0, 25.0]), jnp.float32(1.1), jnp.float32(0.2)))


def far_apart(points):
    """Eq. 12 by brute force: each candidate's sum of distances to all others."""
    return [sum(np.linalg.norm(a - b, axis=1).sum() for b in points) for a in points]


def test_is_a_loop_over_steps_and_landmarks():
    prepared, params = CASCADE.descriptor.prepare(jnp.asarray(CROPS[0])), np.asarray(START)
    for weights, bias, window in zip(CASCADE.weights, CASCADE.biases, CASCADE.windows, strict=True):
        points = params.reshape(4, 2)
        size = np.sqrt(((points - points.mean(0)) ** 2).sum() / (MEAN**2).sum())
        seen = [
            describe_point(CASCADE.descriptor, prepared, jnp.asarray(point), window * size, jnp.float32(0))
            for point in points
        ]
        params = params + size * (np.concatenate(seen) @ np.asarray(weights) + np.asarray(bias))
    assert np.abs(params - START).max() > 2
    np.testing.assert_allclose(jax.jit(fit_face)(CASCADE, CROPS[0], START), params, atol=1e-2)


def test_compiled_is_eager():
    eager = fit_face(CASCADE, jnp.asarray(CROPS[1]), START)
    np.testing.assert_allclose(jax.jit(fit_face)(CASCADE, CROPS[1], START), eager, atol=1e-2)


def test_a_batch_is_a_loop():
    batch = fit_crops(CASCADE, CROPS)
    assert batch.shape == (4, 4, 2)
    for crop, landmarks in zip(CROPS, batch, strict=True):
        np.testing.assert_allclose(fit_crops(CASCADE, crop[None])[0], landmarks, atol=1e-2)


def hidden_units(outputs):
    """Random hidden units of three steps."""
    rng = np.random.default_rng(2)
    shapes = ((3, outputs, 7), (3, 7), (3, 7, SPACE.size))
    return Hidden(*(jnp.asarray(0.3 * rng.normal(size=shape), jnp.float32) for shape in shapes))


def test_hidden_units_are_a_small_network():
    rng = np.random.default_rng(0)
    features, weights, bias = rng.normal(size=(4, 9)), rng.normal(size=(9, 2)), rng.normal(size=SPACE.size)
    directions = rng.normal(size=(2, SPACE.size))
    hidden = jax.tree.map(lambda part: part[0], hidden_units(2))
    regressor = Regressor(*(jnp.asarray(part, jnp.float32) for part in (weights, bias, directions)), hidden)
    found = features @ weights
    units = np.tanh(found @ np.asarray(hidden.weights) + np.asarray(hidden.biases))
    expected = found @ directions + bias + units @ np.asarray(hidden.output)
    np.testing.assert_allclose(regressor.predict(jnp.asarray(features, jnp.float32)), expected, atol=1e-4)


@pytest.mark.parametrize(("rank", "hidden"), [(None, False), (5, False), (5, True), (None, True)])
def test_after_the_first_steps_the_others_lead_to_the_end(rank, hidden):
    cascade, fit, rest = CASCADE, jax.jit(fit_face), slice(1, None)
    if hidden:
        cascade = replace(cascade, hidden=hidden_units(rank or SPACE.size))
    if rank is not None:
        directions = np.linalg.qr(np.random.default_rng(1).normal(size=(3, SPACE.size, rank)))[0].swapaxes(1, 2)
        narrow = tuple(weights[:, :rank] for weights in cascade.weights)
        cascade = replace(cascade, weights=narrow, directions=jnp.asarray(directions, jnp.float32))
    others = replace(
        cascade,
        weights=cascade.weights[rest],
        biases=cascade.biases[rest],
        windows=cascade.windows[rest],
        directions=None if rank is None else cascade.directions[rest],
        hidden=jax.tree.map(lambda part: part[rest], cascade.hidden),
    )
    first = fit(first_steps(cascade, 1), CROPS[0], START)
    assert np.abs(first - START).max() > 0.5
    np.testing.assert_allclose(fit(others, CROPS[0], first), fit(cascade, CROPS[0], START), atol=1e-2)
    for same, whole in zip(jax.tree.leaves(first_steps(cascade, 3)), jax.tree.leaves(cascade), strict=True):
        np.testing.assert_array_equal(same, whole)


def test_an_empty_batch():
    assert jax.eval_shape(fit_crops, CASCADE, CROPS[:0]).shape == (0, 4, 2)


def test_the_first_start_is_upright_in_the_middle():
    middle = SPACE.place(Start(jnp.full(2, 23.5), jnp.float32(1), jnp.float32(0)))
    expected = SPACE.landmarks(jax.jit(fit_face)(CASCADE, CROPS[0], middle))
    np.testing.assert_allclose(fit_crops(CASCADE, CROPS[:1])[0], expected, atol=1e-2)


def test_without_weights_the_start_comes_back():
    still = jax.tree.map(jnp.zeros_like, (CASCADE.weights, CASCADE.biases))
    cascade = replace(CASCADE, weights=still[0], biases=still[1])
    np.testing.assert_array_equal(jax.jit(fit_face)(cascade, CROPS[0], START), START)
    np.testing.assert_allclose(fit_crops(cascade, CROPS), np.broadcast_to(MEAN + FRAME.middle, (4, 4, 2)), atol=1e-5)


def square_of(points):
    low, high = points.min(0), points.max(0)
    return (low + high) / 2, (high - low).max()


@pytest.mark.parametrize("starts", [Starts(), SEVERAL], ids=["one start", "several"])
def test_a_second_pass_starts_where_the_first_one_ended(starts):
    """The mean face with the bounding square of the landmarks that were found."""
    middle, side = square_of(MEAN)
    once = fit_crops(CASCADE, CROPS, starts)
    expected = once
    for passes in (2, 3):
        for row, crop in enumerate(CROPS):
            there, as_large = square_of(np.asarray(expected[row]))
            scale = as_large / side
            start = Start(jnp.asarray(there - scale * middle)[None], jnp.asarray(scale)[None], jnp.zeros(1))
            again = fit_starts(CASCADE, jnp.asarray(crop)[None], start)[0, 0]
            expected = expected.at[row].set(again)
        found = fit_crops(CASCADE, CROPS, starts, passes=passes)
        assert np.abs(found - once).max() > 0.5
        np.testing.assert_allclose(found, expected, atol=0.02)


def test_a_still_cascade_passes_on_the_start():
    still = replace(CASCADE, weights=tuple(0 * of for of in CASCADE.weights), biases=0 * CASCADE.biases)
    np.testing.assert_allclose(fit_crops(still, CROPS, passes=3), fit_crops(still, CROPS), atol=1e-4)
    turned = turned_by(23.0)
    for space in (SPACE, ASM):
        turning = replace(
            still,
            space=space,
            descriptor=Patch(turns=True),
            biases=jnp.zeros((3, space.size)),
            weights=still_weights(space),
        )
        once = fit_crops(turning, CROPS, turned)
        np.testing.assert_allclose(fit_crops(turning, CROPS, turned, passes=2), once, atol=0.02)


def still_weights(space):
    return tuple(jnp.zeros((4 * Patch().size, space.size)) for _ in range(3))


def test_no_passes_are_refused():
    with pytest.raises(InputError, match="at least one pass"):
        fit_crops(CASCADE, CROPS, passes=0)


def test_of_several_starts_the_centroid_of_the_fits_is_kept():
    # fits[k, n] is the fit of crop n from the k-th rotation alone.
    alone = jax.jit(lambda rotation: find(CASCADE, None, jnp.asarray(CROPS), rotation[None])["landmarks"])
    fits = np.stack([alone(rotation) for rotation in SEVERAL.rotations])
    expected = [candidates[np.argmin(far_apart(candidates))] for candidates in fits.swapaxes(0, 1)]
    np.testing.assert_allclose(fit_crops(CASCADE, CROPS, SEVERAL), expected, atol=1e-2)


@pytest.mark.parametrize("count", [1, 2, 3, 6, 11])
def test_the_centroid_is_that_of_brute_force(count):
    for seed in range(5):
        candidates = np.random.default_rng(seed).normal(size=(count, 4, 2)).astype(np.float32)
        found = int(centroid(jnp.asarray(candidates)))
        if count == 2:
            assert found == 0  # a tie
        else:
            assert found == np.argmin(far_apart(candidates))


def test_one_stray_fit_is_never_kept():
    candidates = np.zeros((3, 4, 2), np.float32)
    for stray in (1e4, 1e12, 1e25, np.inf, np.nan):
        candidates[0] = stray
        assert int(centroid(jnp.asarray(candidates))) == 1


def test_fits_on_their_way_out_drown_no_others():
    candidates = np.random.default_rng(0).normal(size=(7, 4, 2)).astype(np.float32)
    expected = 2 + np.argmin(far_apart(candidates[2:]))
    for stray in (1e10, 1e25):
        candidates[0], candidates[1] = stray, -stray
        assert int(centroid(jnp.asarray(candidates))) == expected


@spaces
@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_picture_is_no_harder_for_windows_that_turn(space, quarters):
    # Quarter turns map pixels onto pixels: the fits are the same, turned.
    patch, rng = Patch(turns=True), np.random.default_rng(0)
    cascade = Cascade(
        space=space,
        weights=tuple(jnp.asarray(rng.normal(size=(3, 4 * patch.size, space.size)) * 0.5, jnp.float32)),
        biases=jnp.zeros((3, space.size)),
        windows=jnp.asarray([16.0, 12.0, 8.0]),
        descriptor=patch,
        frame=FRAME,
    )
    turned_crops = np.rot90(CROPS, -quarters, (1, 2)).copy()  # clockwise
    turn = Rotation.from_rotvec([0, 0, quarters * np.pi / 2]).as_matrix()[:2, :2]
    start = Start(jnp.array([[22.0, 25.0]]), jnp.array([1.1]), jnp.array([0.2]))
    centre = jnp.asarray((start.centre - 23.5) @ turn.T + 23.5, jnp.float32)
    turned_start = Start(centre, start.scale, start.rotation + jnp.float32(quarters * np.pi / 2))
    fit, still = jax.jit(fit_starts), replace(cascade, weights=tuple(0 * each for each in cascade.weights))
    for crop, turned_crop in zip(CROPS, turned_crops, strict=True):
        expected = np.asarray(fit(cascade, crop[None], start))
        assert np.abs(expected - fit(still, crop[None], start)).max() > 1
        found = fit(cascade, turned_crop[None], turned_start)
        np.testing.assert_allclose(found, (expected - 23.5) @ turn.T + 23.5, atol=0.02)


@pytest.mark.parametrize("descriptor", [Patch(), Patch(turns=True)], ids=["upright", "turning"])
def test_a_face_goes_in_and_out_as_parameters_in_the_crop(descriptor):
    cascade = replace(random_cascade(descriptor, strength=0.1), biases=jnp.zeros((3, SPACE.size)))
    turned = turned_by(40.0)
    start = starts_of(SPACE, FRAME, turned.rotations)
    params = SPACE.place(jax.tree.map(lambda part: part[0], start))
    expected = fit_crops(cascade, CROPS[:1], turned)[0]
    np.testing.assert_allclose(SPACE.landmarks(jax.jit(fit_face)(cascade, CROPS[0], params)), expected, atol=1e-2)


def test_derivatives_of_the_whole_cascade_are_finite():
    cascade = random_cascade(Sift(), strength=0.02, steps=2)

    def loss(weights, params, crop):
        return (fit_face(replace(cascade, weights=weights), crop, params) ** 2).mean()

    # Compiled without optimisation, which would take twice as long and changes nothing here.
    derivatives = jax.jit(jax.grad(loss, (0, 1)), compiler_options={"xla_backend_optimization_level": 0})
    noise = np.random.default_rng(0).integers(0, 256, (48, 48)).astype(np.uint8)
    half_flat = np.where(np.arange(48) < 24, 200, noise).astype(np.uint8)
    together = jnp.full_like(START, 20.0)
    cases = [(CROPS[0], START), (noise, START), (half_flat, START), (noise, together), (noise, START + 1e4)]
    cases += [(np.full((48, 48), value, np.uint8), START) for value in (0, 200)]
    for crop, params in cases:
        assert all(np.isfinite(found).all() for found in jax.tree.leaves(derivatives(cascade.weights, params, crop)))
    by_weights, by_params = derivatives(cascade.weights, START, noise)
    assert all(np.any(of_step != 0) for of_step in by_weights)
    assert np.any(by_params != 0)


# A head of eight points whose bounding square, seen from the front, lies around its centroid.
HEAD = CameraASM(
    ActiveShapeModel(
        mean=jnp.array(
            [
                [-12.0, -12, 3],
                [12, 12, 3],
                [12, -12, 2],
                [-12, 12, 2],
                [-5, 4, -4],
                [5, -4, -4],
                [2, 6, -9],
                [-2, -6, 7],
            ]
        ),
        modes=jnp.asarray(
            np.linalg.qr(np.random.default_rng(0).normal(size=(24, 2)))[0].T.reshape(2, 8, 3), jnp.float32
        ),
        deviations=jnp.array([3.0, 2.0]),
    ),
    jnp.float32(3.0),
)


def solid_cascade(strength=0.1, turns=True, space=HEAD):
    patch, rng = Patch(turns), np.random.default_rng(0)
    return Cascade(
        space=space,
        weights=tuple(jnp.asarray(strength * rng.normal(size=(3, 8 * patch.size, space.size)), jnp.float32)),
        biases=jnp.zeros((3, space.size)),
        windows=jnp.asarray([16.0, 12.0, 8.0]),
        descriptor=patch,
        frame=FRAME,
    )


def rotations_of(poses):
    """Rotations of roll, pitch and yaw in degrees, by SciPy: y is down, so that looking up turns against the axis."""
    roll, pitch, yaw = np.asarray(poses).T
    return Rotation.from_euler("YXZ", np.stack([yaw, -pitch, roll], 1), degrees=True).as_matrix()


def test_a_still_cascade_gives_the_mean_head_as_it_starts():
    heads = fit_heads(solid_cascade(0.0), CROPS, turned_by(29.0))
    np.testing.assert_allclose(heads.pose, np.tile([29, 0, 0], (4, 1)), atol=1e-4)
    np.testing.assert_array_equal(heads.b, np.zeros((4, 2)))
    assert heads.scale[0] < 0.95  # turned, the square around it is larger
    depths = heads.scale[0] * HEAD.model.mean[:, 2]
    np.testing.assert_allclose(heads.landmarks_3d[..., 2], np.tile(depths, (4, 1)), atol=1e-4)


def test_heads_are_those_of_the_fits_that_are_kept():
    cascade = solid_cascade()
    heads = fit_heads(cascade, CROPS, SEVERAL)
    np.testing.assert_allclose(heads.landmarks, fit_crops(cascade, CROPS, SEVERAL), atol=1e-2)
    np.testing.assert_allclose(heads.landmarks_3d[..., :2], heads.landmarks, atol=1e-3)
    shapes = np.asarray(HEAD.model.mean + np.tensordot(heads.b, HEAD.model.modes, 1))
    turned = np.asarray(heads.scale)[:, None, None] * shapes @ rotations_of(heads.pose).swapaxes(1, 2)
    places = np.asarray(heads.landmarks_3d) - turned
    np.testing.assert_allclose(places[..., 2], 0, atol=1e-3)
    np.testing.assert_allclose(places[..., :2], np.broadcast_to(places[:, :1, :2], (4, 8, 2)), atol=1e-3)
    assert np.abs(heads.pose).min() > 0.1


@pytest.mark.parametrize("quarters", [1, 3])
def test_a_turned_picture_turns_the_head(quarters):
    # Quarter turns map pixels onto pixels: the fits are the same, turned.
    cascade, heads = solid_cascade(), fit_heads(solid_cascade(), CROPS)
    turned = fit_heads(cascade, np.rot90(CROPS, -quarters, (1, 2)).copy(), turned_by(90.0 * quarters))
    turn = Rotation.from_rotvec([0, 0, quarters * np.pi / 2]).as_matrix()
    np.testing.assert_allclose(rotations_of(turned.pose), turn @ rotations_of(heads.pose), atol=2e-3)
    centred = np.asarray(heads.landmarks_3d) - [23.5, 23.5, 0]
    np.testing.assert_allclose(turned.landmarks_3d, centred @ turn.T + [23.5, 23.5, 0], atol=0.02)
    np.testing.assert_allclose(turned.scale, heads.scale, rtol=1e-3)
    np.testing.assert_allclose(turned.b, heads.b, atol=0.02)


def test_a_head_is_aligned_to_the_landmarks_of_a_2d_cascade():
    pose, scale, b = np.array([12.0, -20.0, 25.0]), 1.1, np.array([3.0, -2.5])
    head = np.asarray(HEAD.model.mean + np.tensordot(b, HEAD.model.modes, 1))
    seen = scale * head @ rotations_of([pose])[0].T
    points = PointSpace(jnp.asarray(seen[:, :2], jnp.float32))
    still = replace(
        solid_cascade(0.0, turns=False), space=points, weights=(jnp.zeros((72, 16)),) * 3, biases=jnp.zeros((3, 16))
    )
    heads = fit_heads(still, CROPS[:2], aligned=HEAD)
    np.testing.assert_allclose(heads.landmarks, np.tile(seen[:, :2] + FRAME.middle, (2, 1, 1)), atol=1e-3)
    assert np.linalg.norm(heads.landmarks_3d[..., :2] - heads.landmarks, axis=-1).mean() < 0.3
    np.testing.assert_allclose(heads.landmarks_3d[..., 2], np.tile(seen[:, 2], (2, 1)), atol=0.6)
    np.testing.assert_allclose(heads.pose, np.tile(pose, (2, 1)), atol=3)
    np.testing.assert_allclose(heads.scale, scale, rtol=0.03)
    np.testing.assert_allclose(heads.b, np.tile(b, (2, 1)), atol=0.6)


def test_a_head_goes_in_and_out_as_parameters_and_has_derivatives():
    cascade = solid_cascade()
    upright = HEAD.place(Start(jnp.full(2, FRAME.middle), jnp.ones(()), jnp.zeros(())))
    heads = fit_heads(cascade, CROPS[:1])
    params = jax.jit(fit_face)(cascade, CROPS[0], upright)
    np.testing.assert_allclose(HEAD.pose(params), heads.pose[0], atol=1e-2)
    np.testing.assert_allclose(HEAD.b(params), heads.b[0], atol=1e-2)
    np.testing.assert_allclose(HEAD.landmarks_3d(params), heads.landmarks_3d[0], atol=1e-2)
    slope = jax.jit(
        jax.grad(lambda start: (HEAD.pose(fit_face(cascade, jnp.asarray(CROPS[0]), start)) ** 2).sum()),
        compiler_options={"xla_backend_optimization_level": 0},
    )(upright)
    assert np.isfinite(slope).all()
    assert np.any(slope != 0)


def test_heads_of_an_empty_batch():
    heads = jax.eval_shape(fit_heads, solid_cascade(), CROPS[:0])
    assert [part.shape for part in heads] == [(0, 8, 2), (0, 8, 3), (0, 3), (0,), (0, 2)]


def test_impossible_heads_are_refused():
    with pytest.raises(InputError, match="expected a cascade of 3D regression, or a 3D shape space to align"):
        fit_heads(CASCADE, CROPS)
    with pytest.raises(InputError, match=r"expected crops \(N, 48, 48\)"):
        fit_heads(solid_cascade(), CROPS[:, 1:])
