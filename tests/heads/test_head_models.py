"""Head models: what they learn, what they say of one scheme's points, their files, and the bundled one."""

import itertools
import runpy
from dataclasses import replace
from functools import partial
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
from jax import numpy as jnp
from safetensors.numpy import load as unpack
from safetensors.numpy import save as pack
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation
from tensor_files import load_bytes, repack

import jaxfit.models
from jaxfit.errors import InputError, ModelError
from jaxfit.heads.facekit import facekit_points, read_facekit, sample_heads
from jaxfit.heads.mesh_points import union
from jaxfit.heads.model import (
    DEFAULT_HEAD_MODEL,
    HeadModel,
    bundled_head_models,
    learn_head_model,
    load_head_model,
    save_head_model,
)
from jaxfit.models.files import bundled as models
from jaxfit.models.files import load
from jaxfit.schemes.known import AFLW21, IBUG68, LFPW27, LFPW29, LFPW29_NAMES, SCHEMES, scheme_named
from jaxfit.shapes.asm import ActiveShapeModel

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "build_head.py"
SETS = {"points3": (4, 0, 2), "points5": (0, 1, 3, 5, 6)}
THREE, FIVE = scheme_named("points3"), scheme_named("points5")


def random_head(modes=6, points=7):
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(3 * points, modes)))[0].T.reshape(modes, points, 3)
    shape = ActiveShapeModel(
        mean=jnp.asarray(rng.normal(0, 5, (points, 3)), jnp.float32),
        modes=jnp.asarray(axes, jnp.float32),
        deviations=jnp.asarray(np.linspace(2, 0.5, modes), jnp.float32),
    )
    return HeadModel(shape, SETS, "random numbers")


def covariance(shape):
    scaled = np.asarray(shape.deviations, np.float64)[:, None] * np.asarray(shape.modes, np.float64).reshape(
        len(shape.modes), -1
    )
    return scaled.T @ scaled


def freedom(mean):
    """Projection (3 L, 3 L) on what no similarity does to points (L, 3), by small moves, turns and growth of them."""
    small = 1e-6
    moved = [mean + small * axis for axis in np.eye(3)]
    moved += [Rotation.from_rotvec(small * axis).apply(mean) for axis in np.eye(3)]
    slopes = (np.stack([*moved, (1 + small) * mean]) - mean).reshape(7, -1) / small
    axes = null_space(slopes, rcond=1e-4)
    return axes @ axes.T


# What a head model says of one scheme


def test_the_part_has_the_covariance_of_the_whole_at_its_points_less_what_a_camera_does():
    head = random_head()
    for scheme in (THREE, FIVE):
        part, indices = head.of(scheme, 1.0), list(SETS[scheme.name])
        wide = covariance(head.shape).reshape(7, 3, 7, 3)[np.ix_(indices, range(3), indices, range(3))]
        free = freedom(np.asarray(part.mean, np.float64))
        expected = free @ wide.reshape(3 * scheme.count, -1) @ free
        np.testing.assert_allclose(covariance(part), expected, atol=1e-5)


def test_the_part_and_the_whole_have_the_same_samples():
    head = random_head()
    b = np.random.default_rng(1).normal(size=(20_000, 6)) * np.asarray(head.shape.deviations)
    faces = np.tensordot(b, np.asarray(head.shape.modes), 1)[:, SETS["points5"]].reshape(20_000, -1)
    part = head.of(FIVE, 1.0)
    free = freedom(np.asarray(part.mean, np.float64))
    np.testing.assert_allclose(covariance(part), np.cov(free @ faces.T), atol=0.1)


def test_modes_do_nothing_that_a_camera_does():
    for part in (random_head(12).of(THREE, 1.0), random_head(12).of(FIVE, 0.9), load_head_model().of(AFLW21, 0.95)):
        flat = np.asarray(part.modes, np.float64).reshape(len(part.modes), -1)
        np.testing.assert_allclose(flat @ freedom(np.asarray(part.mean, np.float64)), flat, atol=2e-6)


def test_points_may_be_chosen_in_any_order_and_twice():
    head = random_head()
    chosen, named = head.of_points((4, 0, 2), 0.9), head.of(THREE, 0.9)
    for part, array in vars(named).items():
        np.testing.assert_array_equal(getattr(chosen, part), array)
    twice = head.of_points([5, 1, 2, 5, 3], 1.0)
    for points in (twice.mean[None], twice.modes):
        np.testing.assert_allclose(points[:, 0], points[:, 3], atol=1e-6)
    assert head.indices(THREE) == (4, 0, 2)


def test_modes_are_orthonormal_and_sorted():
    part = random_head().of(FIVE, 1.0)
    flat = np.asarray(part.modes).reshape(len(part.modes), -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-5)
    assert (np.diff(part.deviations) <= 0).all()


def test_the_mean_is_the_whole_ones_about_its_centroid():
    head = random_head()
    part, own = head.of(THREE, 0.9), np.asarray(head.shape.mean)[[4, 0, 2]]
    np.testing.assert_allclose(np.asarray(part.mean).mean(0), 0, atol=1e-6)
    np.testing.assert_allclose(part.mean, own - own.mean(0), atol=1e-6)


def test_all_points_of_a_head_that_no_camera_does_are_the_whole():
    everything = {"points7": tuple(range(7))}
    whole = replace(random_head(), sets=everything).of(scheme_named("points7"), 1.0)
    part = HeadModel(whole, everything, "").of(scheme_named("points7"), 1.0)
    np.testing.assert_allclose(part.mean, whole.mean, atol=1e-6)
    np.testing.assert_allclose(part.deviations, whole.deviations, rtol=1e-5)
    signs = np.sign(np.sum(np.asarray(part.modes) * np.asarray(whole.modes), (1, 2)))
    np.testing.assert_allclose(part.modes * signs[:, None, None], whole.modes, atol=1e-5)


def test_no_more_modes_than_directions_and_just_enough_for_the_variance():
    head = random_head(modes=12)
    # Seven of their directions are the camera's.
    assert len(head.of(THREE, 1.0).deviations) == 9 - 7
    assert len(head.of(FIVE, 1.0).deviations) == 15 - 7
    whole = np.asarray(head.of(FIVE, 1.0).deviations) ** 2
    shares = np.cumsum(whole) / whole.sum()
    for variance in (0.3, 0.6, 0.9, 0.99):
        kept = len(head.of(FIVE, variance).deviations)
        assert shares[kept - 1] >= variance - 1e-6
        assert kept == 1 or shares[kept - 2] < variance


def test_a_scheme_that_it_lacks():
    for asked in (random_head().indices, lambda scheme: random_head().of(scheme, 0.9)):
        with pytest.raises(InputError, match="no points of scheme ibug68; it has points3, points5"):
            asked(IBUG68)


@pytest.mark.parametrize("variance", [0.0, 1.1, float("nan")])
def test_shares_that_are_none(variance):
    with pytest.raises(InputError, match="share"):
        random_head().of(THREE, variance)


# Learning


def turned_heads(count=300):
    """Heads of three known modes, each in any position, size and (a little) turned."""
    rng = np.random.default_rng(2)
    mean = rng.normal(0, 5, (7, 3))
    modes = np.linalg.qr(rng.normal(size=(21, 3)))[0].T.reshape(3, 7, 3)
    faces = mean + np.tensordot(rng.normal(size=(count, 3)) * [0.6, 0.4, 0.2], modes, 1)
    turns = Rotation.from_rotvec(rng.normal(0, 0.2, (count, 3))).as_matrix()
    scales = rng.uniform(0.8, 1.2, (count, 1, 1))
    return mean, scales * faces @ turns + rng.normal(0, 30, (count, 1, 3))


def test_learning_takes_position_size_and_turn_away():
    mean, heads = turned_heads()
    head = learn_head_model(heads, SETS, 1.0, "random")
    found, centred = np.asarray(head.shape.mean, np.float64), mean - mean.mean(0)
    turn, _ = Rotation.align_vectors(centred, found)
    np.testing.assert_allclose(turn.apply(found), centred, atol=0.15)
    # As they are turned on average, and as large.
    assert np.degrees(turn.magnitude()) < 2
    radii = np.sqrt(heads.var(1).sum(1))
    np.testing.assert_allclose(np.sqrt(found.var(0).sum()), radii.mean(), rtol=0.01)
    # Three modes, of which alignment takes some variance, and little that its curvature adds.
    deviations = np.asarray(head.shape.deviations)
    assert deviations[0] < 0.7
    assert np.sum(deviations[:3] ** 2) > 0.97 * np.sum(deviations**2)


def test_heads_already_aligned_stay_as_they_are():
    rng = np.random.default_rng(3)
    mean = rng.normal(0, 5, (7, 3))
    heads = mean - mean.mean(0) + rng.normal(0, 1e-3, (300, 7, 3))
    np.testing.assert_allclose(learn_head_model(heads, SETS, 0.9, "").shape.mean, mean - mean.mean(0), atol=2e-3)


def test_lfpw27_comes_with_lfpw29():
    heads = np.random.default_rng(4).normal(size=(30, 1, 3)) + np.random.default_rng(5).normal(size=(30, 29, 3)) / 9
    heads += np.random.default_rng(6).normal(size=(29, 3)) * 5
    head = learn_head_model(heads, {"lfpw29": tuple(range(28, -1, -1))}, 0.9, "")
    assert set(head.sets) == {"lfpw29", "lfpw27"}
    kept = [index for index, name in enumerate(LFPW29_NAMES) if not name.endswith("eyebrow_center_bottom")]
    assert head.sets["lfpw27"] == tuple(28 - index for index in kept)
    assert head.of(LFPW27, 0.9).mean.shape == (27, 3)


@pytest.mark.parametrize(
    ("heads", "sets", "said"),
    [
        (np.zeros((4, 7, 2)), SETS, "expected finite landmarks"),
        (np.full((4, 7, 3), np.nan), SETS, "expected finite landmarks"),
        (np.ones((4, 7, 3)), {"points3": (0, 1)}, "expected 3 indices"),
        (np.ones((4, 7, 3)), {"points3": (0, 1, 7)}, "expected 3 indices below 7"),
        (np.ones((4, 7, 3)), {}, "at least one set"),
        (np.ones((4, 7, 3)), {"face": (0,)}, "unknown landmark scheme"),
        (np.random.default_rng(0).normal(size=(1, 7, 3)).repeat(300, 0), SETS, "same shape"),
    ],
)
def test_heads_to_learn_nothing_from(heads, sets, said):
    with pytest.raises(InputError, match=said):
        learn_head_model(heads, sets, 0.9, "")


def test_the_script_builds_a_head_from_facewarehouse(tmp_path, monkeypatch, capsys):
    mean, heads = turned_heads(40)
    for tester, pose in itertools.product((1, 2), range(20)):
        path = tmp_path / f"Tester_{tester}" / "TrainingPose" / f"pose_{pose}.obj"
        path.parent.mkdir(parents=True, exist_ok=True)
        theirs = heads[20 * (tester - 1) + pose] * [1, -1, -1] / 10  # decimetres; y up, z to the viewer
        path.write_text("".join(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in theirs))
    (tmp_path / "Tester_3").mkdir()
    (tmp_path / "points.json").write_text('{"points5": [0, 1, 2, 3, 4], "points3": [6, 5, {"vertices": [0, 1]}]}')
    out = tmp_path / "head.safetensors"
    arguments = ["--facewarehouse", tmp_path, "--points", tmp_path / "points.json", "--variance", "1", "--out", out]
    monkeypatch.setattr("sys.argv", ["build_head.py", *map(str, arguments)])
    assert runpy.run_path(str(SCRIPT))["main"]() == 0
    head = load_head_model(out)
    assert head.sets == {"points5": (0, 1, 2, 3, 4), "points3": (5, 6, 7)}
    assert "FaceWarehouse" in head.source
    points = np.stack([*mean[:5], mean[6], mean[5], mean[:2].mean(0)])
    turn, _ = Rotation.align_vectors(points - points.mean(0), np.asarray(head.shape.mean))
    assert np.degrees(turn.magnitude()) < 6
    np.testing.assert_allclose(turn.apply(head.shape.mean), points - points.mean(0), atol=0.5)
    said = capsys.readouterr()
    assert "40 heads, 8 points" in said.out
    assert "20 problems" in said.err


# Files


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("heads") / "good.safetensors"
    save_head_model(random_head(), path)
    return path.read_bytes()


@pytest.fixture
def loaded(tmp_path, monkeypatch):
    """Loads bytes: the head model, or the words of the ModelError."""
    # Users have no checks of types at run time: they must not be what refuses a file.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    return partial(load_bytes, load_head_model, tmp_path / "head.safetensors")


repacked = partial(repack, "jaxfit-head")


def test_a_loaded_head_is_the_saved_one(tmp_path):
    original = random_head()
    save_head_model(original, str(tmp_path / "a.safetensors"))
    found = load_head_model(str(tmp_path / "a.safetensors"))
    for name, array in vars(original.shape).items():
        np.testing.assert_array_equal(getattr(found.shape, name), array)
    assert (found.sets, found.source) == (original.sets, original.source)
    save_head_model(found, tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_truncated_files_are_refused(good, loaded):
    for length in {*range(40), *np.linspace(40, len(good) - 1, 40).astype(int)}:
        assert "copy or build it again" in loaded(good[:length])
    assert "copy or build it again" in loaded(good + b"\0")


def test_any_changed_byte_gives_a_head_or_a_model_error(good, loaded):
    rng = np.random.default_rng(0)
    for place in [*range(0, 400), *rng.integers(0, len(good), 100)]:
        data = bytearray(good)
        data[place] ^= int(rng.integers(1, 256))
        assert isinstance(loaded(bytes(data)), HeadModel | str)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("mean", None),
        ("mean", np.zeros((7, 2), np.float32)),
        ("mean", np.zeros((0, 3), np.float32)),
        ("mean", np.array(3, np.float32)),
        ("mean", np.zeros((7, 3), np.int32)),
        ("mean", np.full((7, 3), np.nan, np.float32)),
        ("modes", None),
        ("modes", np.zeros((5, 7, 3), np.float32)),
        ("modes", np.zeros((6, 8, 3), np.float32)),
        ("modes", np.zeros((6, 7, 3), np.float64)),
        ("deviations", None),
        ("deviations", np.zeros(6, np.float32)),
        ("deviations", -np.ones(6, np.float32)),
        ("deviations", np.full(6, np.inf, np.float32)),
        ("deviations", np.ones((6, 1), np.float32)),
    ],
)
def test_wrong_arrays_are_refused(good, loaded, name, array):
    assert "copy or build it again" in loaded(repacked(good, **{name: array}))


@pytest.mark.parametrize(
    "change",
    [
        lambda header: header.pop("sets"),
        lambda header: header.pop("source"),
        lambda header: header.update(source=3),
        lambda header: header.update(sets={}),
        lambda header: header.update(sets=[1]),
        lambda header: header.update(sets={"points3": [0, 1]}),
        lambda header: header.update(sets={"points3": [0, 1, 7]}),
        lambda header: header.update(sets={"points3": [0, 1, -1]}),
        lambda header: header.update(sets={"points3": [0, 1, 1.0]}),
        lambda header: header.update(sets={"points3": [0, 1, True]}),
        lambda header: header.update(sets={"face": [0, 1]}),
    ],
)
def test_wrong_headers_are_refused(good, loaded, change):
    assert "copy or build it again" in loaded(repacked(good, change))


@pytest.mark.parametrize("header", ["[]", "3", "null", '"text"', "{", "[" * 50_000])
def test_headers_of_another_kind_are_refused(good, loaded, header):
    assert "copy or build it again" in loaded(pack(unpack(good), {"jaxfit-head": header}))


def test_another_version_and_other_files(good, loaded, tmp_path):
    for version in (0, 9):
        assert f"format {version}" in loaded(repacked(good, lambda header, v=version: header.update(format=v)))
    assert "without our header" in loaded(pack({"mean": np.zeros(3)}))
    (tmp_path / "head.safetensors").write_bytes(good)
    with pytest.raises(ModelError, match="not a jaxfit model"):
        load(tmp_path / "head.safetensors")
    with pytest.raises(ModelError, match="not a jaxfit head model"):
        load_head_model(Path(jaxfit.models.__file__).parent / "bundled" / f"{models()[0]}.safetensors")
    with pytest.raises(ModelError, match=f"no head model 'none': .*{DEFAULT_HEAD_MODEL}"):
        load_head_model("none")


def test_what_cannot_be_saved(tmp_path):
    head = random_head()
    for path in (tmp_path / "a.npz", tmp_path / "none" / "a.safetensors"):
        with pytest.raises(InputError, match="safetensors"):
            save_head_model(head, path)
    broken = replace(head, shape=replace(head.shape, deviations=head.shape.deviations.at[2].set(jnp.nan)))
    with pytest.raises(InputError, match="not saved: expected deviations"):
        save_head_model(broken, tmp_path / "a.safetensors")
    with pytest.raises(InputError, match="not saved: expected 3 indices"):
        save_head_model(replace(head, sets={"points3": (0, 1, 9)}), tmp_path / "a.safetensors")
    assert list(tmp_path.iterdir()) == []


# The bundled head


@pytest.fixture(scope="module")
def bundled():
    return load_head_model()


def test_it_is_listed_small_and_says_where_it_comes_from(bundled):
    assert bundled_head_models() == [DEFAULT_HEAD_MODEL]
    assert bundled.source == "ICT-FaceKit, (c) 2020 USC Institute for Creative Technologies, MIT licence"
    assert set(bundled.sets) == set(SCHEMES)


@pytest.mark.parametrize("scheme", SCHEMES.values(), ids=lambda scheme: scheme.name)
def test_means_are_symmetric_and_look_straight_ahead(bundled, scheme):
    mean = np.asarray(bundled.of(scheme, 0.95).mean)
    np.testing.assert_allclose(mean[list(scheme.mirror)] * [-1, 1, 1], mean, atol=0.05)  # half a millimetre
    left, right = mean[list(scheme.outer_eyes)]
    # The eyes are level, and as far apart as people's, 8 to 10 cm from corner to corner.
    assert 8 < right[0] - left[0] < 10
    np.testing.assert_allclose(right[1:], left[1:], atol=0.05)


def test_noses_point_to_the_viewer_and_chins_are_below(bundled):
    for scheme, nose, chin in ((IBUG68, 30, 8), (AFLW21, 14, 20), (LFPW29, 20, 28), (LFPW27, 18, 26)):
        mean = np.asarray(bundled.of(scheme, 0.95).mean)
        assert mean[:, 2].argmin() == nose
        assert mean[:, 1].argmax() == chin
        assert abs(mean[nose, 0]) < 0.05
        assert mean[nose, 2] < -1


def test_points_lie_where_the_schemes_say(bundled):
    mean = np.asarray(bundled.shape.mean)
    aflw, lfpw, ibug = (mean[list(bundled.sets[scheme.name])] for scheme in (AFLW21, LFPW29, IBUG68))
    # Left to right: corner, pupil, corner; in front of the corners and between the lids.
    for out, pupil, inner in ((6, 7, 8), (11, 10, 9)):
        assert min(aflw[out, 0], aflw[inner, 0]) < aflw[pupil, 0] < max(aflw[out, 0], aflw[inner, 0])
        assert aflw[pupil, 2] < aflw[[out, inner], 2].min()
    for top, pupil, bottom in ((12, 16, 13), (14, 17, 15)):
        assert lfpw[top, 1] < lfpw[pupil, 1] < lfpw[bottom, 1]
    # Brows above lids, and their upper edges above their lower.
    for top, bottom, lid in ((4, 5, 12), (6, 7, 14)):
        assert lfpw[top, 1] < lfpw[bottom, 1] < lfpw[lid, 1]
    # Ears outside and behind everything else, below the eyes and above the chin.
    others = np.delete(aflw, [12, 16], 0)
    assert aflw[12, 0] < others[:, 0].min()
    assert aflw[16, 0] > others[:, 0].max()
    assert aflw[[12, 16], 2].min() > others[:, 2].max() + 3
    assert aflw[[7, 10], 1].max() < aflw[[12, 16], 1].min() < aflw[20, 1]
    # Points of the same meaning are the same points.
    pairs = [(36, 6), (39, 8), (42, 9), (45, 11), (48, 17), (54, 19), (8, 20)]
    for own, other in pairs:
        np.testing.assert_array_equal(ibug[own], aflw[other])
    np.testing.assert_allclose(ibug[60:].mean(0), aflw[18], atol=1e-4)


def test_modes_are_orthonormal(bundled):
    for shape in (bundled.shape, bundled.of(AFLW21, 0.95)):
        flat = np.asarray(shape.modes).reshape(len(shape.modes), -1)
        np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-4)


def test_faces_differ_by_millimetres(bundled):
    spread = np.sqrt(covariance(bundled.of(IBUG68, 1.0)).trace() / 68)
    assert 0.2 < spread < 1.0


def test_pairs_of_random_faces_differ(bundled):
    shape = bundled.of(LFPW29, 0.95)
    rng = np.random.default_rng(0)
    b = rng.normal(size=(4, len(shape.deviations))) * np.asarray(shape.deviations)
    faces = [np.asarray(shape.reconstruct(jnp.asarray(one, jnp.float32))) for one in b]
    for one, other in itertools.combinations(faces, 2):
        assert 0.1 < np.linalg.norm(one - other, axis=1).mean() < 3


def test_the_bundled_file_is_what_the_script_builds(shared_data, bundled):
    path = shared_data / "ict" / "ict_facekit.npz"
    if not path.is_file():
        pytest.skip("needs ICT-FaceKit")
    points, sets = union(facekit_points())
    assert {name: bundled.sets[name] for name in sets} == sets
    heads = sample_heads(read_facekit(path), points)
    assert heads.shape == (3000, len(points), 3)
    # Its Gaussian reproduces any of the heads, moved and turned onto its mean.
    mean, modes = (np.asarray(part, np.float64) for part in (bundled.shape.mean, bundled.shape.modes))
    for head in heads[::150]:
        centred = head - head.mean(0)
        turned = Rotation.align_vectors(mean, centred)[0].apply(centred)
        turned *= np.sum(mean**2) / np.sum(turned * mean)
        b = np.tensordot(turned - mean, modes, ((0, 1), (1, 2)))
        rest = turned - mean - np.tensordot(b, modes, 1)
        assert np.linalg.norm(rest, axis=1).max() < 0.1
        assert np.linalg.norm(b / np.asarray(bundled.shape.deviations)) < 3 * np.sqrt(len(b))
