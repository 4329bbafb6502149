"""ICT-FaceKit: a small generated model with known heads, and the real one where it is at hand."""

import numpy as np
import pytest

from jaxfit.errors import DatasetError, InputError
from jaxfit.heads.facekit import facekit_points, read_facekit, sample_heads
from jaxfit.heads.mesh_points import MeshPoints
from jaxfit.schemes.known import scheme_named

SIDED = [
    *(
        "browDown",
        "browInnerUp",
        "browOuterUp",
        "cheekPuff",
        "cheekSquint",
        "eyeBlink",
        "eyeLookDown",
        "eyeLookIn",
        "eyeLookOut",
    ),
    *("eyeLookUp", "eyeSquint", "eyeWide", "mouthDimple", "mouthFrown", "mouthLowerDown", "mouthPress", "mouthSmile"),
    *("mouthStretch", "mouthUpperUp", "noseSneer"),
]
SINGLE = [
    *("jawForward", "jawLeft", "jawOpen", "jawRight", "mouthClose", "mouthFunnel", "mouthLeft"),
    *("mouthPucker", "mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper"),
]
NAMES = [f"{name}_{side}" for name in SIDED for side in "LR"] + SINGLE
VERTICES = 60
ALL = MeshPoints(np.arange(VERTICES)[:, None], np.ones((VERTICES, 1)))


def arrays(identities=4):
    """Expression k moves vertex k alone, by 1 cm along x: a sampled head tells its own weights."""
    rng = np.random.default_rng(0)
    expression = np.zeros((len(NAMES), VERTICES, 3), np.float16)
    expression[range(len(NAMES)), range(len(NAMES)), 0] = 1
    return {
        "generic": rng.normal(size=(VERTICES, 3)).astype(np.float32),
        "identity": rng.normal(size=(identities, VERTICES, 3)).astype(np.float16),
        "expression": expression,
        "expression_names": np.array(NAMES),
        "quads": np.array([[0, 1, 2, 3], [2, 3, 4, -1]], np.int32),
        "landmarks68": np.arange(3),
    }


@pytest.fixture
def write(tmp_path):
    def written(**changes):
        content = {name: array for name, array in (arrays() | changes).items() if array is not None}
        np.savez(tmp_path / "kit.npz", **content)
        return tmp_path / "kit.npz"

    return written


@pytest.fixture
def weights(write):
    """The weights (people, faces, expressions) of sampled heads."""
    kit = read_facekit(write(identity=np.zeros((1, VERTICES, 3), np.float16)))
    heads = sample_heads(kit, ALL, people=200, expressions=10)
    return (heads - kit.generic)[:, : len(NAMES), 0].reshape(200, 10, len(NAMES))


def test_axes_become_ours(write):
    kit = read_facekit(write())
    given = arrays()
    # From y up and z to the viewer to y down and z away; x is the picture's right in both.
    np.testing.assert_array_equal(kit.generic, given["generic"] @ np.diag([1, -1, -1]).astype(np.float32))
    np.testing.assert_array_equal(kit.identity[3, 7], given["identity"][3, 7].astype(np.float32) * [1, -1, -1])
    assert kit.expression_names == tuple(NAMES)


def test_people_are_normally_distributed_about_the_generic_head(write):
    kit = read_facekit(write())
    heads = sample_heads(kit, ALL, people=4000, expressions=1)
    offsets = (heads - kit.generic).reshape(4000, -1)
    basis = kit.identity.reshape(4, -1)
    coefficients = offsets @ np.linalg.pinv(basis)
    np.testing.assert_allclose(coefficients @ basis, offsets, atol=1e-4)
    np.testing.assert_allclose(coefficients.mean(0), 0, atol=0.06)
    np.testing.assert_allclose(np.cov(coefficients.T), np.eye(4), atol=0.08)


def test_the_first_face_of_everyone_is_neutral_and_people_keep_their_identity(write):
    kit = read_facekit(write())
    heads = sample_heads(kit, ALL, people=3, expressions=5).reshape(3, 5, VERTICES, 3)
    still = slice(len(NAMES), None)  # no expression moves these
    np.testing.assert_allclose(heads[:, :, still], np.broadcast_to(heads[:, :1, still], heads[:, :, still].shape))
    alone = sample_heads(kit, ALL, people=3, expressions=1)
    np.testing.assert_array_equal(alone, heads[:, 0])
    assert (np.abs(heads[:, 1:] - heads[:, :1]).max((2, 3)) > 0).mean() > 0.5


def test_the_seed_decides(write):
    kit = read_facekit(write())
    first, again, other = (sample_heads(kit, ALL, 2, 3, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1


def test_only_the_points_are_sampled(write):
    kit = read_facekit(write())
    some = MeshPoints(np.array([[3, 0], [7, 9]]), np.array([[1, 0], [0.25, 0.75]]))
    np.testing.assert_allclose(sample_heads(kit, some, 2, 3), some.at(sample_heads(kit, ALL, 2, 3)), atol=1e-6)


def test_expressions_are_sparse_and_within_their_limits(weights):
    assert (weights >= 0).all()
    highest = dict(zip(NAMES, weights.max((0, 1)), strict=True))
    assert 0.5 < highest["jawOpen"] <= 0.6 + 1e-6
    assert 0.4 < highest["mouthSmile_L"] <= 0.5 + 1e-6
    assert max(highest.values()) <= 1 + 1e-6
    # Every expression happens but for the correction of the jaw.
    assert {name for name, most in highest.items() if most < 1e-6} == {"mouthClose"}
    active = (weights[:, 1:] > 1e-6).sum(2)
    assert 2 < active.mean() < 8
    assert active.max() <= 15


def test_both_sides_mostly_do_the_same(weights):
    moving = weights[:, 1:].reshape(-1, len(NAMES))
    left, right = (moving[:, [NAMES.index(f"{name}_{side}") for name in SIDED]] for side in "LR")
    gaze = np.array([name in ("eyeLookIn", "eyeLookOut") for name in SIDED])
    both, alike = (left > 1e-6) & (right > 1e-6), np.abs(left - right) < 1e-5
    np.testing.assert_array_equal((left > 1e-6)[:, ~gaze], (right > 1e-6)[:, ~gaze])
    assert 0.6 < alike[both].mean() < 0.85
    # Where one side is weaker, it is either.
    assert 0.4 < (left > right)[both & ~alike].mean() < 0.6
    # Both eyes look the same way.
    inward, outward = SIDED.index("eyeLookIn"), SIDED.index("eyeLookOut")
    np.testing.assert_array_equal(left[:, inward] > 1e-6, right[:, outward] > 1e-6)


def test_opposites_exclude_each_other(weights):
    moving = dict(zip(NAMES, (weights > 1e-6).reshape(-1, len(NAMES)).T, strict=True))
    for one, other in [
        ("jawLeft", "jawRight"),
        ("eyeBlink_L", "eyeWide_L"),
        ("mouthSmile_L", "mouthFrown_L"),
        ("eyeLookUp_L", "eyeLookDown_L"),
        ("mouthLeft", "mouthRight"),
    ]:
        assert moving[one].any()
        assert not (moving[one] & moving[other]).any()


@pytest.mark.parametrize(("people", "expressions"), [(0, 1), (1, 0)])
def test_no_heads_are_refused(write, people, expressions):
    with pytest.raises(InputError, match="at least one"):
        sample_heads(read_facekit(write()), ALL, people, expressions)


def test_a_model_without_an_expression_is_refused(write):
    names = np.array([name.replace("jawOpen", "jaw") for name in NAMES])
    with pytest.raises(DatasetError, match="jawOpen"):
        sample_heads(read_facekit(write(expression_names=names)), ALL)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"generic": None}, "generic is not a file|generic"),
        ({"quads": None}, "quads"),
        ({"generic": np.zeros((VERTICES, 2), np.float32)}, "expected generic"),
        ({"generic": np.float32(1)}, "expected generic"),
        ({"generic": np.zeros((0, 3), np.float32)}, "expected generic"),
        ({"generic": np.full((VERTICES, 3), np.nan, np.float32)}, "expected generic"),
        ({"identity": np.zeros((4, VERTICES - 1, 3), np.float16)}, "expected identity"),
        ({"identity": np.float32(1)}, "expected identity"),
        ({"expression": np.zeros((3, VERTICES, 3), np.float16)}, "expected expression"),
        ({"expression": np.zeros((len(NAMES), VERTICES, 3), int)}, "expected expression"),
        ({"expression_names": np.arange(len(NAMES))}, "expected expression_names"),
        ({"expression_names": np.array(NAMES)[None]}, "expected expression_names"),
        ({"expression_names": np.array([{}] * len(NAMES))}, "pickle"),
        ({"quads": np.zeros((2, 3), np.int32)}, "expected quads"),
        ({"quads": np.zeros((2, 4))}, "expected quads"),
        ({"quads": np.full((2, 4), VERTICES)}, "name vertex 60"),
    ],
)
def test_what_is_wrong_is_said(write, changes, said):
    with pytest.raises(DatasetError, match=said):
        read_facekit(write(**changes))


def test_damaged_files_are_refused(write, tmp_path):
    good = write().read_bytes()
    damaged = tmp_path / "damaged.npz"
    for length in np.linspace(0, len(good) - 1, 40).astype(int):
        damaged.write_bytes(good[:length])
        with pytest.raises(DatasetError, match=r"damaged\.npz"):
            read_facekit(damaged)
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(DatasetError, match=r"expected an \.npz file"):
        read_facekit(tmp_path / "one.npy")
    with pytest.raises(DatasetError, match="No such file"):
        read_facekit(tmp_path / "none.npz")


def test_landmarks_on_the_real_head(shared_data):
    path = shared_data / "ict" / "ict_facekit.npz"
    if not path.is_file():
        pytest.skip("needs ICT-FaceKit")
    kit, sets = read_facekit(path), facekit_points()
    assert set(sets) == {"ibug68", "aflw21", "lfpw29"}
    # Brows, the nose's ridge and its tip are where people label them, and all else where ICT-FaceKit has it.
    moved = {*range(17, 27), *range(28, 31)}
    with np.load(path) as file:
        differ = sets["ibug68"].vertices[:, 0] != file["landmarks68"]
    assert set(np.flatnonzero(differ)) == moved
    for name, points in sets.items():
        scheme = scheme_named(name)
        face = points.at(kit.generic)
        assert face.shape == (scheme.count, 3)
        # In the scheme's order of mirror images, the head's points are its mirror image, within 0.1 mm.
        np.testing.assert_allclose(face[list(scheme.mirror)] * [-1, 1, 1], face, atol=0.01)
        left, right = scheme.outer_eyes
        assert face[left, 0] < -4 < 4 < face[right, 0]
