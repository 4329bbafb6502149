"""Exported models find what ``fit_crops`` and ``fit_heads`` find, also where jaxfit cannot be imported."""

import json
import os
import pickle
import re
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import jax
import jaxtyping
import numpy as np
import pytest
from jax import export
from safetensors.numpy import load as unpack
from safetensors.numpy import save as pack
from small import FRAME, PLACEMENTS, random_model

import jaxfit
from jaxfit.cascade.fit import fit_crops, fit_heads
from jaxfit.cascade.starts import Starts
from jaxfit.errors import ModelError
from jaxfit.fitting import export as exporting
from jaxfit.fitting.batches import BATCHES
from jaxfit.fitting.export import export_model, load_exported
from jaxfit.models.model import Model
from jaxfit.schemes.known import AFLW21

ROOT = Path(__file__).resolve().parents[2]
COUNT = 13  # faces: a large batch and some single ones
LIMIT = "jax_traceback_in_locations_limit"
IN_3D = {"landmarks", "landmarks_3d", "pose", "scale", "b"}

pytestmark = pytest.mark.usefixtures("two_batches")


@pytest.fixture(scope="module")
def two_batches() -> Iterator[None]:
    """Programs for batches of two sizes only: each has to be compiled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "BATCHES", (8, 1))
        yield


def pictures(count: int) -> np.ndarray:
    """Crops of smooth noise, whose gradients have orientations that rounding does not change."""
    noise = np.random.default_rng(1).normal(size=(count, FRAME.crop, FRAME.crop))
    smooth = np.stack([cv2.GaussianBlur(picture, (0, 0), 3) for picture in noise])
    return np.clip(128 + 500 * smooth, 0, 255).astype(np.uint8)


def expected(model: Model, crops: np.ndarray, starts: Starts = Starts()) -> dict[str, np.ndarray]:
    """What this package itself finds."""
    if model.space_3d is None:
        return {"landmarks": np.asarray(fit_crops(model.cascade, crops, starts))}
    heads = fit_heads(model.cascade, crops, starts, aligned=model.aligned)
    return {name: np.asarray(values) for name, values in heads._asdict().items()}


def assert_same(found: Mapping[str, np.ndarray], truth: dict[str, np.ndarray]) -> None:
    """Up to rounding, which may move a gradient from one orientation bin to the next where batches differ."""
    assert set(found) == set(truth)
    for name in truth:
        assert found[name].shape == truth[name].shape
        # Pictures differ by far more than this.
        np.testing.assert_allclose(found[name], truth[name], rtol=0, atol=0.03 * truth[name].std(0).mean())


STARTS = {"sdm": Starts(), "parametric": Starts(3), "regression3d": Starts()}


@pytest.fixture(scope="module")
def folder(two_batches: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Exports of three models, one of which starts three times."""
    folder = tmp_path_factory.mktemp("exports")
    for kind, starts in STARTS.items():
        export_model(random_model(kind), folder / f"{kind}.safetensors", starts)
    return folder


@pytest.fixture(scope="module")
def good(folder: Path) -> bytes:
    """The bytes of a sound file."""
    return (folder / "sdm.safetensors").read_bytes()


@pytest.mark.parametrize("kind", STARTS)
def test_any_number_of_crops_gives_what_the_model_gives(folder: Path, kind: str) -> None:
    exported, crops = load_exported(folder / f"{kind}.safetensors"), pictures(COUNT)
    truth = expected(random_model(kind), crops, STARTS[kind])
    assert truth["landmarks"].std(0).mean() > 0.2  # pixels: the steps do something, to each picture what suits it
    assert_same(exported(crops), truth)
    for count in (0, 1, 5):
        found = exported(crops[:count])
        assert set(found) == set(exported.outputs) == (IN_3D if kind == "regression3d" else {"landmarks"})
        for name, values in found.items():
            assert values.dtype == np.float32 == np.dtype(exported.outputs[name]["dtype"])
            assert [*values.shape] == [count, *exported.outputs[name]["shape"][1:]]
            np.testing.assert_allclose(
                values, truth[name][:count], rtol=0, atol=0.03 * float(truth[name].std(0).mean())
            )


def test_alignments_are_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exporting, "BATCHES", (1,))  # which compile long
    model, crops = random_model("alignment3d"), pictures(2)
    starts = Starts(3, -20.0, 20.0)
    export_model(model, tmp_path / "a.safetensors", starts)
    exported = load_exported(tmp_path / "a.safetensors")
    assert exported.starts == starts
    assert set(exported.outputs) == IN_3D
    assert_same(exported(crops), expected(model, crops, starts))


def test_what_an_export_says_of_itself(folder: Path) -> None:
    exported = load_exported(folder / "parametric.safetensors")
    assert (exported.frame, exported.scheme, exported.placements) == (FRAME, AFLW21, PLACEMENTS)
    assert exported.starts == Starts(3)
    data = (folder / "parametric.safetensors").read_bytes()
    header = header_of(data)
    assert header["jax"] == jax.__version__
    assert header["platforms"] == ["cpu", "cuda"]
    assert header["inputs"]["crops"]["shape"] == ["N", FRAME.crop, FRAME.crop]
    assert header["inputs"]["crops"]["dtype"] == "uint8"
    tensors = unpack(data)
    programs = {name for name, tensor in tensors.items() if tensor.dtype == np.uint8}
    assert programs == {f"fit_{size}" for size in header["batches"]} == {"fit_8", "fit_1"}
    assert tensors["weights.0"].dtype == np.float16
    for name in programs:
        program = export.deserialize(bytearray(tensors[name]))
        assert program.calling_convention_version == header["calling_convention"]
        assert program.platforms == ("cpu", "cuda")


def test_there_is_a_program_for_each_batch_that_fits_are_made_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporting, "BATCHES", BATCHES)
    export_model(random_model("sdm"), tmp_path / "whole.safetensors")
    data = (tmp_path / "whole.safetensors").read_bytes()
    assert header_of(data)["batches"] == [64, 8, 1]
    assert {name for name in unpack(data) if name.startswith("fit_")} == {"fit_64", "fit_8", "fit_1"}


def test_every_model_has_its_own_arrays_and_all_are_used(folder: Path) -> None:
    tensors = unpack((folder / "regression3d.safetensors").read_bytes())
    names = [name for name in sorted(tensors) if not name.startswith("fit_")]
    program = export.deserialize(bytearray(tensors["fit_1"]))
    assert [aval.shape for aval in program.in_avals[1:]] == [tensors[name].shape for name in names]


def test_the_same_model_gives_the_same_bytes_that_name_no_folder(good: bytes, folder: Path, tmp_path: Path) -> None:
    limit = getattr(jax.config, LIMIT)
    export_model(random_model("sdm"), tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == good
    assert getattr(jax.config, LIMIT) == limit
    for path in folder.iterdir():
        data = path.read_bytes()
        assert str(ROOT).encode() not in data
        assert b".py" not in data
    export_model(random_model("sdm"), tmp_path / "other.safetensors", Starts(3))
    assert (tmp_path / "other.safetensors").read_bytes() != good


PAGE = ROOT / "docs" / "reference" / "exported-files.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
# Whose import of jaxfit fails as if it were not installed.
CHILD = """
import sys
sys.modules["jaxfit"] = None
code, path, crops, out = sys.argv[1:]
names = {"path": path}
exec(code, names)
import numpy
numpy.savez(out, **names["fit"](numpy.load(crops)))
assert not [name for name in sys.modules if name.startswith("jaxfit.")]
"""


@pytest.mark.parametrize(("kind", "count"), [("parametric", 9), ("regression3d", 4)])
def test_the_documented_lines_fit_without_jaxfit(folder: Path, tmp_path: Path, kind: str, count: int) -> None:
    crops = pictures(9)[:count]
    np.save(tmp_path / "crops.npy", crops)
    paths = [str(folder / f"{kind}.safetensors"), str(tmp_path / "crops.npy"), str(tmp_path / "found.npz")]
    command = [sys.executable, "-I", "-c", CHILD, BLOCKS[0], *paths]
    quick = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    child = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=quick)
    assert child.returncode == 0, child.stderr
    with np.load(tmp_path / "found.npz") as found:
        assert_same(found, expected(random_model(kind), crops, STARTS[kind]))


@pytest.mark.parametrize("kind", PLACEMENTS)
@pytest.mark.parametrize("side", [17, 60, 150, 900])
def test_the_documented_lines_cut_the_same_crops(folder: Path, kind: str, side: int) -> None:
    names: dict[str, Any] = {"path": folder / "sdm.safetensors"}
    for block in BLOCKS:
        exec(compile(block, "exported-files.md", "exec"), names)
    picture = cv2.resize(pictures(1)[0], (200, 180), interpolation=cv2.INTER_CUBIC)
    box = np.array([30.0, 20.5, side, 1.2 * side])
    crops, problems = jaxfit.crop_faces(random_model("sdm"), [picture], [box], kind=kind)
    assert not problems
    pixels, scale, offset = names["cut"](picture, box, kind)
    assert np.abs(pixels.astype(int) - crops.pixels[0]).max() <= 1  # grey values, rounded
    points = np.array([[0.0, 0.0], [20.0, 30.0]])
    np.testing.assert_allclose(scale * points + offset, crops.to_images(points[None])[0], atol=1e-9)


@pytest.mark.parametrize(
    "crops",
    [
        np.zeros((2, 48, 48)),
        np.zeros((2, 48, 47), np.uint8),
        np.zeros((48, 48), np.uint8),
        np.zeros((1, 48, 48, 3), np.uint8),
        np.uint8(7),
        [],
    ],
    ids=["floats", "size", "single", "colour", "number", "list"],
)
def test_other_crops_are_refused(folder: Path, crops: Any) -> None:
    with pytest.raises(jaxfit.InputError, match=r"expected crops as a uint8 array \(N, 48, 48\); got"):
        load_exported(folder / "sdm.safetensors")(crops)


def header_of(data: bytes) -> dict:
    length = int.from_bytes(data[:8], "little")
    return json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["jaxfit-export"])


def repacked(good: bytes, header: dict | None = None, **tensors: np.ndarray) -> bytes:
    """A well-formed file with another header or other tensors."""
    return pack(unpack(good) | tensors, {"jaxfit-export": json.dumps(header or header_of(good))})


@pytest.fixture
def refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[bytes], str]:
    """Gives the words in which bytes are refused. Any other exception than a ModelError fails the test."""
    path = tmp_path / "export.safetensors"
    # Users have no checks of types at run time: they must not be what refuses a file.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)

    def words(data: bytes) -> str:
        path.write_bytes(data)
        with pytest.raises(ModelError, match=re.escape(f"{path}: ")) as error:
            load_exported(path)
        return str(error.value)

    return words


def test_truncated_files_are_refused(good: bytes, refusal: Callable[[bytes], str]) -> None:
    header = 8 + int.from_bytes(good[:8], "little")
    for length in (0, 4, 8, header // 2, header, header + 1, len(good) - 1):
        assert "copy or export it again" in refusal(good[:length])
    assert "copy or export it again" in refusal(good + b"\0")


def test_a_flipped_bit_is_noticed_wherever_it_is(good: bytes, refusal: Callable[[bytes], str]) -> None:
    rng, start = np.random.default_rng(0), 8 + int.from_bytes(good[:8], "little")
    places = [*rng.integers(8, start, 20), *rng.integers(start, len(good), 20)]
    for place in places:
        data = bytearray(good)
        data[place] ^= 1 << int(rng.integers(8))
        assert "again" in refusal(bytes(data)) or "without our header" in refusal(bytes(data))
    swapped = unpack(good)
    assert "checksum" in refusal(repacked(good, fit_8=swapped["fit_1"]))
    assert "checksum" in refusal(repacked(good, biases=np.zeros_like(swapped["biases"])))
    assert "checksum" in refusal(repacked(good, more=np.ones(3, np.float32)))
    assert "checksum" in refusal(repacked(good, header_of(good) | {"scheme": "lfpw29"}))


def test_other_files_are_refused(good: bytes, refusal: Callable[[bytes], str], tmp_path: Path) -> None:
    jaxfit.save(random_model("sdm"), tmp_path / "model.safetensors")
    model = (tmp_path / "model.safetensors").read_bytes()
    assert "not a jaxfit exported model: a safetensors file without our header" in refusal(model)
    assert "without our header" in refusal(pack({"weights": np.ones(3)}))
    for data in (b"", b"\x89PNG\r\n", pickle.dumps({"a": 1}), struct.pack("<Q", 2) + b"[]"):
        assert "not an exported model, or damaged" in refusal(data)
    assert "not an exported model, or damaged ('sha256')" in refusal(repacked(good, {"format": 1}))
    (tmp_path / "export.safetensors").write_bytes(good)
    with pytest.raises(ModelError, match="not a jaxfit model: a safetensors file without our header"):
        jaxfit.load(tmp_path / "export.safetensors")
    for missing in (tmp_path / "none.safetensors", tmp_path, "a\0b"):
        with pytest.raises(ModelError, match=r"no exported model .*expected the path of a file"):
            load_exported(missing)


def test_other_formats_and_versions_of_jax_say_what_to_do(
    good: bytes, refusal: Callable[[bytes], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for version in (0, 2):
        words = refusal(repacked(good, header_of(good) | {"format": version}))
        assert f"exported model format {version}, but this release reads format 1" in words
        assert "or export it again" in words
    convention = header_of(good)["calling_convention"]
    monkeypatch.setattr(export, "maximum_supported_calling_convention_version", convention - 1)
    words = refusal(good)
    assert f"exported by JAX {jax.__version__}" in words
    assert f"calling convention {convention}" in words
    monkeypatch.undo()

    def too_new(_: bytes) -> None:
        raise NotImplementedError("unsupported serialization version")

    monkeypatch.setattr(export, "deserialize", too_new)
    words = refusal(good)
    assert "unsupported serialization version" in words
    assert "use that version, or export the model again" in words


def test_programs_that_call_other_code_are_refused(good: bytes, refusal: Callable[[bytes], str]) -> None:
    """An undamaged file of somebody's, whose program is written to a file by Python when it runs."""

    def evil(crops: jax.Array, arrays: dict[str, jax.Array]) -> dict[str, jax.Array]:
        return {"landmarks": jax.ffi.ffi_call("xla_ffi_python_cpu_callback", crops)(crops)}

    header, tensors = header_of(good), unpack(good)
    shapes = {
        name: jax.ShapeDtypeStruct(array.shape, np.float32) for name, array in tensors.items() if "fit" not in name
    }
    side = header["frame"]["crop"]
    checks = [export.DisabledSafetyCheck.custom_call("xla_ffi_python_cpu_callback")]
    made = export.export(jax.jit(evil), platforms=["cpu"], disabled_checks=checks)(
        jax.ShapeDtypeStruct((1, side, side), np.uint8), shapes
    )
    tensors["fit_1"] = np.frombuffer(made.serialize(), np.uint8)
    header.pop("sha256")
    header["sha256"] = exporting._checksum(header, tensors)
    assert "its programs call xla_ffi_python_cpu_callback" in refusal(repacked(good, header, fit_1=tensors["fit_1"]))


def test_what_cannot_be_exported_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = random_model("sdm")
    for name in ("model.npz", "model", "none/model.safetensors"):
        with pytest.raises(jaxfit.InputError, match=r"ending in \.safetensors in a folder that exists"):
            export_model(model, tmp_path / name)
    target = tmp_path / "a.safetensors"
    large = replace(model, cascade=replace(model.cascade, weights=tuple(1e6 * each for each in model.cascade.weights)))
    with pytest.raises(jaxfit.InputError, match="weights: not finite, or too large for float16"):
        export_model(large, target)

    def not_installed(*_: Any) -> None:
        raise ImportError("flatbuffers")

    monkeypatch.setattr(export.Exported, "serialize", not_installed)
    with pytest.raises(jaxfit.InputError, match=r"jaxfit\[export\]"):
        export_model(model, target)
    monkeypatch.undo()
    export_model(model, target)
    monkeypatch.setattr(export, "deserialize", not_installed)
    with pytest.raises(jaxfit.InputError, match=r"jaxfit\[export\]"):
        load_exported(target)
    assert [*tmp_path.iterdir()] == [target]
