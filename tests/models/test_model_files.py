"""Saving and loading is the identity; whatever a file holds, loading it gives a model or a ModelError."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="attr-defined"

import itertools
import json
import os
import pickle
import struct
from dataclasses import replace
from functools import partial

import jax
import jaxtyping
import numpy as np
import pytest
from jax import numpy as jnp
from safetensors.numpy import load as unpack
from safetensors.numpy import save as pack
from tensor_files import header_of, load_bytes, repack

from jaxfit.cascade.model import Cascade, Hidden
from jaxfit.cascade.starts import Spread
from jaxfit.descriptors.dense import Dense
from jaxfit.descriptors.sift import Sift
from jaxfit.errors import InputError, ModelError
from jaxfit.image.frame import Frame
from jaxfit.models.files import bundled, load, read_usual_fits, save
from jaxfit.models.model import Model
from jaxfit.models.placements import Placement
from jaxfit.schemes.known import scheme_named
from jaxfit.schemes.own import own_scheme
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.points import PointSpace
from jaxfit.shapes.similarity import SimilarityASM
from jaxfit.shapes.space import Start

PLACEMENT = Placement((0.01, -0.02), 0.1, Spread((0.05, 0.06), 0.07, 0.08))


START = Start(jnp.zeros(2, jnp.float32), jnp.float32(1), jnp.float32(0))


def model(seed=0, scheme="points2"):
    rng = np.random.default_rng(seed)
    count = scheme_named(scheme).count
    weights = (0.1 * rng.normal(size=(2, count * 128, 2 * count))).astype(np.float16)
    cascade = Cascade(
        space=PointSpace(jnp.asarray(rng.normal(0, 8, (count, 2)), jnp.float32)),
        weights=tuple(jnp.asarray(weights, jnp.float32)),
        biases=jnp.asarray(rng.normal(size=(2, 2 * count)), jnp.float32),
        windows=jnp.array([14.0, 9.0]),
        descriptor=Sift("principal", "vector"),
        frame=Frame(crop=40, face=20.0),
    )
    placements = {"square": PLACEMENT, "haar": replace(PLACEMENT, shift=(0.3, 0.4))}
    return Model(cascade, scheme_named(scheme), placements, {"method": "sdm", "windows": [0.7, 0.45], "faces": 12})


def parametric_model():
    rng = np.random.default_rng(1)
    shapes = ActiveShapeModel(
        mean=jnp.asarray(rng.normal(0, 8, (2, 2)), jnp.float32),
        modes=jnp.asarray(rng.normal(size=(3, 2, 2)), jnp.float32),
        deviations=jnp.array([3.0, 2.0, 1.0]),
    )
    points = model()
    cascade = replace(
        points.cascade,
        space=SimilarityASM(shapes, jnp.float32(4.5)),
        weights=tuple(jnp.asarray(rng.normal(size=(2, 256, 8)).astype(np.float16), jnp.float32)),
        biases=jnp.asarray(rng.normal(size=(2, 8)), jnp.float32),
        descriptor=Sift("face", "cell"),
    )
    return replace(points, cascade=cascade)


def head_space(points=2, modes=3):
    rng = np.random.default_rng(2)
    shapes = ActiveShapeModel(
        mean=jnp.asarray(rng.normal(0, 8, (points, 3)), jnp.float32),
        modes=jnp.asarray(rng.normal(size=(modes, points, 3)), jnp.float32),
        deviations=jnp.arange(1.0, modes + 1),
    )
    return CameraASM(shapes, jnp.float32(3.5))


def alignment_model():
    return replace(parametric_model(), aligned=head_space())


def regression_model():
    points, rng = model(), np.random.default_rng(3)
    cascade = replace(
        points.cascade,
        space=head_space(),
        weights=tuple(jnp.asarray(rng.normal(size=(2, 256, 9)).astype(np.float16), jnp.float32)),
        biases=jnp.asarray(rng.normal(size=(2, 9)), jnp.float32),
    )
    return replace(points, cascade=cascade)


def narrow_model():
    """Of steps along one direction, on the dense descriptor."""
    points, rng = model(), np.random.default_rng(4)
    cascade = replace(
        points.cascade,
        weights=tuple(jnp.asarray(rng.normal(size=(2, 256, 1)).astype(np.float16), jnp.float32)),
        directions=jnp.asarray(rng.normal(size=(2, 1, 4)), jnp.float32),
        descriptor=Dense("face"),
    )
    return replace(points, cascade=cascade)


def hidden_model():
    """Of steps along one direction, with five hidden units."""
    narrow, rng = narrow_model(), np.random.default_rng(5)
    shapes = ((2, 1, 5), (2, 5), (2, 5, 4))
    hidden = Hidden(*(jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes))
    return replace(narrow, cascade=replace(narrow.cascade, hidden=hidden))


def same_arrays(a, b):
    pairs = zip(jax.tree.leaves((a.cascade, a.aligned)), jax.tree.leaves((b.cascade, b.aligned)), strict=True)
    return all(np.array_equal(one, other) for one, other in pairs)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """The bytes of a sound file."""
    path = tmp_path_factory.mktemp("models") / "good.safetensors"
    save(model(), path)
    return path.read_bytes()


@pytest.fixture
def loaded(tmp_path, monkeypatch):
    """Loads bytes: the model, or the words of the ModelError."""
    # Users have no checks of types at run time: they must not be what refuses a file.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    return partial(load_bytes, load, tmp_path / "model.safetensors")


repacked = partial(repack, "jaxfit")


def test_a_loaded_model_is_the_saved_one(tmp_path):
    original = model()
    save(original, tmp_path / "a.safetensors")
    found = load(tmp_path / "a.safetensors")
    assert same_arrays(found, original)
    assert jax.tree.structure(found.cascade) == jax.tree.structure(original.cascade)  # descriptor and frame, too
    assert (found.scheme, found.placements, found.training) == (
        original.scheme,
        original.placements,
        original.training,
    )


@pytest.mark.parametrize("scheme", ["points1", "aflw21", "ibug68"])
def test_every_scheme(tmp_path, scheme):
    original = model(scheme=scheme)
    save(original, str(tmp_path / "a.safetensors"))
    found = load(str(tmp_path / "a.safetensors"))
    assert found.scheme == original.scheme
    assert same_arrays(found, original)


def test_schemes_of_ones_own(tmp_path, loaded):
    own = own_scheme({"name": "needle", "points": ["tip", "eye"], "lines": [[1, 2]], "normaliser": ["eye", "tip"]})
    original = replace(model(), scheme=own.of(scheme_named("points2")))
    save(original, tmp_path / "a.safetensors")
    assert load(tmp_path / "a.safetensors").scheme == original.scheme
    data = (tmp_path / "a.safetensors").read_bytes()
    damage = {"names": ["tip"], "lines": [[0, 7]], "count": 3, "name": "ibug68", "normaliser": "outer"}
    for key, value in damage.items():
        change = partial(dict.update, **{key: value})
        outcome = loaded(repacked(data, lambda header, change=change: change(header["scheme"])))
        assert isinstance(outcome, str), key


def test_the_same_model_gives_the_same_bytes(tmp_path):
    paths = [tmp_path / f"{name}.safetensors" for name in "abc"]
    save(model(), paths[0])
    save(model(), paths[1])
    save(load(paths[0]), paths[2])
    first, second, third = (path.read_bytes() for path in paths)
    assert first == second == third
    save(model(seed=1), paths[0])
    assert paths[0].read_bytes() != first


def test_truncated_files_are_refused(good, loaded):
    lengths = {*range(40), *np.linspace(40, len(good) - 1, 60).astype(int)}
    for length in lengths:
        assert "copy or train it again" in loaded(good[:length])
    assert "copy or train it again" in loaded(good + b"\0")


def test_changed_bytes_give_a_model_or_a_model_error(good, loaded):
    rng = np.random.default_rng(0)
    header = 8 + int.from_bytes(good[:8], "little")
    for _ in range(300):
        data = bytearray(good)
        for _ in range(rng.integers(1, 4)):
            data[rng.integers(header)] = rng.integers(256)
        assert isinstance(loaded(bytes(data)), str | Model)


def test_random_bytes_are_refused(loaded):
    rng = np.random.default_rng(0)
    for length in (1, 7, 8, 9, 100, 10_000):
        assert isinstance(loaded(rng.bytes(length)), str)
        # A plausible length of the header before them.
        assert isinstance(loaded(struct.pack("<Q", length) + rng.bytes(2 * length)), str)


@pytest.mark.parametrize("header", [b"", b"{}", b"[]", b"7", b'"jaxfit"', b"null", b"\xff", b"[" * 100_000, b"{" * 9])
def test_odd_headers_are_refused(loaded, header):
    assert isinstance(loaded(struct.pack("<Q", len(header)) + header), str)
    assert isinstance(loaded(pack({}, {"jaxfit": header.decode(errors="replace")})), str)


def test_any_value_anywhere_in_the_header_gives_a_model_or_a_model_error(good, loaded):
    values = [None, True, -1, 10**400, 1e300, float("nan"), "", "points3", "x" * 50, [], [1], {}, {"a": 1}]

    def places(node, path=()):
        yield path
        children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, child in children:
            yield from places(child, (*path, key))

    def put(path, value, header):
        for key in path[:-1]:
            header = header[key]
        header[path[-1]] = value

    paths = [path for path in places(header_of(good, "jaxfit")) if path]
    for path, value in itertools.product(paths, values):
        outcome = loaded(repacked(good, partial(put, path, value)))
        assert isinstance(outcome, str | Model)
        if path[0] in ("space", "scheme") or (path[0] == "placements" and value != value):
            assert isinstance(outcome, str), (path, value)


@pytest.mark.parametrize(
    "change",
    [
        lambda header: header["frame"].update(crop=200.5),
        lambda header: header["frame"].update(crop=True),
        lambda header: header["frame"].update(crop=1e9),
        lambda header: next(iter(header["placements"].values())).update(log_scale=500.0),
        lambda header: next(iter(header["placements"].values())).update(shift=[1e6, 0.0]),
        lambda header: next(iter(header["placements"].values()))["spread"].update(rotation=-1.0),
    ],
)
def test_values_out_of_any_sense_are_refused(good, loaded, change):
    assert isinstance(loaded(repacked(good, change)), str)


def test_numbers_that_overlap_or_lie_elsewhere_are_refused(good, loaded):
    length = int.from_bytes(good[:8], "little")
    header, numbers = json.loads(good[8 : 8 + length]), good[8 + length :]
    tensors = sorted((name for name in header if name != "__metadata__"), key=lambda name: header[name]["data_offsets"])
    for name, moved in itertools.product(tensors, (-4, -2, 2, 1 << 20, -(1 << 20), 1 << 62)):
        changed = json.loads(json.dumps(header))
        changed[name]["data_offsets"] = [place + moved for place in header[name]["data_offsets"]]
        text = json.dumps(changed).encode()
        assert isinstance(loaded(struct.pack("<Q", len(text)) + text + numbers), str), (name, moved)


def test_missing_entries_are_refused(good, loaded):
    for name in ("format", "space", "descriptor", "frame", "scheme", "placements", "training"):
        assert name in loaded(repacked(good, lambda header, name=name: header.pop(name)))


ASM = {
    "space.model.mean": [(3, 2), (2, 3)],
    "space.model.modes": [(4, 2, 2), (3, 2, 3), (3, 4)],
    "space.model.deviations": [(2,), (3, 1)],
    "space.sigmas": [(2,)],
}
CAMERA = {
    "model.mean": [(2, 2), (3, 3), (6,)],
    "model.modes": [(3, 2, 2), (4, 2, 3), (3, 6)],
    "model.deviations": [(4,)],
    "sigmas": [(1,)],
}
STEPS = {"weights": [(2, 256, 3), (2, 128, 4), (256, 4)], "biases": [(3, 4)], "windows": [(3,), ()]}
WRONG_SHAPES = [
    (model, STEPS | {"space.mean": [(3, 2), (2, 3), (4,), (0, 2)]}),
    (narrow_model, {"directions": [(1, 1, 4), (2, 1, 3), (2, 2, 4), (1, 4)]}),
    (
        hidden_model,
        {
            "hidden.weights": [(2, 2, 5), (1, 1, 5), (2, 1, 4)],
            "hidden.biases": [(2, 4), (3, 5)],
            "hidden.output": [(2, 5, 3), (2, 6, 4), (10, 4)],
        },
    ),
    (parametric_model, ASM),
    (alignment_model, {f"head.{name}": shapes for name, shapes in CAMERA.items()}),
    (regression_model, {f"space.{name}": shapes for name, shapes in CAMERA.items()}),
]


@pytest.mark.parametrize(
    ("made", "name", "shapes"),
    [(made, name, shapes) for made, arrays in WRONG_SHAPES for name, shapes in arrays.items()],
)
def test_damaged_arrays_are_refused(tmp_path, loaded, made, name, shapes):
    """Of another shape, left out, or with a value that is no number."""
    save(made(), tmp_path / "good.safetensors")
    data = (tmp_path / "good.safetensors").read_bytes()
    good = unpack(data)[name]
    assert isinstance(loaded(repacked(data, **{name: good})), Model)
    for shape in shapes:
        assert shape != good.shape
        assert "damaged" in loaded(repacked(data, **{name: np.ones(shape, good.dtype)}))
    # Without directions, weights are not as wide as there are parameters.
    assert ("weights" if name == "directions" else name) in loaded(repacked(data, **{name: None}))
    for value, place in itertools.product((np.nan, np.inf, -np.inf), (0, -1)):
        array = good.copy()
        array.flat[place] = value
        assert f"{name} has values that are not finite" in loaded(repacked(data, **{name: array}))


def test_a_consistent_file_of_another_number_of_landmarks_is_refused(good, loaded):
    tensors = {"weights": np.ones((2, 256, 6), np.float16), "biases": np.ones((2, 6), np.float32)}
    assert "damaged" in loaded(repacked(good, **tensors, **{"space.mean": np.ones((3, 2), np.float32)}))


def test_numbers_of_another_type_are_refused(good, loaded):
    for kind in (np.float64, np.int32, np.bool_):
        assert "16- or 32-bit numbers" in loaded(repacked(good, biases=np.ones((2, 4), kind)))


@pytest.mark.parametrize("version", [0, 999])
def test_an_older_or_later_format_says_what_to_do(good, loaded, version):
    words = loaded(repacked(good, lambda header: header.update(format=version)))
    assert f"model format {version}, but this release reads format 1" in words
    assert "use the release it was made with, or train it again" in words


def test_other_safetensors_files_are_refused(loaded):
    for metadata in (None, {}, {"format": "pt"}):
        assert "without our header" in loaded(pack({"weights": np.ones(3)}, metadata))


class Trap:
    """Unpickling it would write a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def test_pickles_are_refused_and_not_executed(loaded, tmp_path):
    assert "damaged" in loaded(pickle.dumps(Trap(str(tmp_path / "sprung"))))
    assert not (tmp_path / "sprung").exists()


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(ModelError, match="no model 'nothing': expected one of the bundled models"):
        load("nothing")
    with pytest.raises(ModelError, match=f"no model '{tmp_path}'"):
        load(tmp_path)
    (tmp_path / "empty.safetensors").touch()
    for read in (load, read_usual_fits):
        with pytest.raises(ModelError, match=rf"{tmp_path}/empty\.safetensors: not a jaxfit model, or damaged"):
            read(tmp_path / "empty.safetensors")


@pytest.mark.parametrize("name", ["model", "model.npz", "none/model.safetensors"])
def test_impossible_file_names_are_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"ending in \.safetensors in a folder that exists"):
        save(model(), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("fails", ["fsync", "replace"])
def test_a_failing_disk_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, fails):
    path = tmp_path / "a.safetensors"
    save(model(), path)
    before = path.read_bytes()

    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, fails, full)
    with pytest.raises(OSError, match="no space left"):
        save(model(seed=1), path)
    assert [*tmp_path.iterdir()] == [path]
    assert path.read_bytes() == before


def test_a_model_without_steps_is_refused(tmp_path):
    model = load("fast68")
    none = replace(
        model.cascade,
        weights=(jnp.zeros((0, 1)),),
        biases=model.cascade.biases[:0],
        windows=model.cascade.windows[:0],
        directions=model.cascade.directions[:0],
    )
    save(replace(model, cascade=none), tmp_path / "none.safetensors")
    with pytest.raises(ModelError, match="there are no steps"):
        load(tmp_path / "none.safetensors")


@pytest.mark.parametrize("name", ["fast68", "parametric68"])
def test_how_a_model_fits_is_known_without_its_arrays(name):
    whole = load(name)
    assert read_usual_fits(name) == (whole.cascade.frame, whole.starts)


def test_bundled_models_load():
    for name in bundled():
        found = load(name)
        mean = found.cascade.space.landmarks(found.cascade.space.place(START))
        assert mean.shape == (found.scheme.count, 2)
        assert all(np.isfinite(array).all() for array in jax.tree.leaves(found.cascade))
        in_3d = found.training["method"].endswith("3d")
        assert (found.space_3d is not None) == in_3d
        assert (found.aligned is not None) == (found.training["method"] == "alignment3d")


def test_a_model_says_what_it_is_in_a_line():
    said = repr(load("regression68-3d"))
    assert len(said.splitlines()) == 1
    assert len(said) < 200
    assert "68 landmarks (ibug68), 3D shape and pose; regression3d in " in said


def test_files_from_before_heads_still_load(good, loaded):
    # What they hold is what those of 2D models hold now.
    assert not any(name.startswith("head") for name in unpack(good))
    found = loaded(good)
    assert found.aligned is found.space_3d is None


def test_a_model_knows_square_boxes():
    with pytest.raises(InputError, match="placement of 'square' boxes"):
        replace(model(), placements={"haar": PLACEMENT})
    with pytest.raises(InputError, match="boxes of the kinds square, haar; got 'yunet'"):
        model().placement("yunet")
    assert model().placement("square") == PLACEMENT


@pytest.mark.parametrize("made", [parametric_model, alignment_model, regression_model, narrow_model, hidden_model])
def test_models_of_all_methods_come_back_as_they_were(tmp_path, made):
    path = tmp_path / "a.safetensors"
    save(made(), path)
    again = load(path)
    assert same_arrays(again, made())
    assert type(again.cascade.space) is type(made().cascade.space)
    assert type(again.space_3d) is type(made().space_3d)
    assert again.cascade.descriptor == made().cascade.descriptor
    save(again, tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()


def test_the_space_of_3d_results():
    assert model().space_3d is parametric_model().space_3d is None
    regressed = regression_model()
    assert regressed.space_3d is regressed.cascade.space
    aligned = alignment_model()
    assert aligned.space_3d is aligned.aligned
    # What is aligned comes first, as in fitting.
    both = replace(regressed, aligned=head_space(modes=2))
    assert both.space_3d is both.aligned


def test_a_head_of_other_points_than_the_cascade_finds_is_refused(tmp_path, loaded):
    save(replace(alignment_model(), aligned=head_space(points=3)), tmp_path / "odd.safetensors")
    assert "head.model.mean has shape (3, 3)" in loaded((tmp_path / "odd.safetensors").read_bytes())


def test_heads_that_are_not_finite_are_not_saved(tmp_path):
    away = replace(head_space(), sigmas=jnp.float32(np.inf))
    with pytest.raises(InputError, match=r"head\.sigmas: not finite"):
        save(replace(alignment_model(), aligned=away), tmp_path / "a.safetensors")
