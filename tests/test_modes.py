"""Modes of JAX that a program may have set, and processes in which JAX cannot compute."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import drawn_faces
import drawn_heads
import jax
import numpy as np
import pytest

import jaxfit
from jaxfit import modes
from jaxfit.cascade.fit import _require_crops
from jaxfit.errors import InputError, ProcessError
from jaxfit.evaluation import start_boxes
from jaxfit.schemes.known import AFLW21

# All at once, as each costs a compilation: float64 at hand, types and ranks that must not be mixed, no NaNs and no
# transfers.
MODES = {
    "jax_enable_x64": True,
    "jax_numpy_dtype_promotion": "strict",
    "jax_debug_nans": True,
    "jax_numpy_rank_promotion": "raise",
    "jax_transfer_guard": "disallow",
}


@pytest.fixture
def strict() -> Iterator[None]:
    """Within it JAX's modes are set, for all threads, as the environment sets them."""
    before = {name: getattr(jax.config, name) for name in MODES}
    for name, value in MODES.items():
        jax.config.update(name, value)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_everything_works_in_all_modes_and_stays_float32(
    strict: None, drawn: Path, drawn_model: Path, heads: tuple, tmp_path: Path
) -> None:
    found = jaxfit.read_dataset(f"pts:{drawn}")
    faces = found.faces[:12]
    options = drawn_faces.OPTIONS.but(detectors=False, windows=(0.5,))
    parametric = jaxfit.train(faces, found.scheme, method="parametric", options=options).model
    model = jaxfit.load(drawn_model)
    short = replace(model, cascade=jaxfit.cascade.first_steps(model.cascade, 1))
    tuned = jaxfit.finetune(short, faces, tuning=jaxfit.Tuning(epochs=1, batch=4), mirror=False).model
    of_heads = drawn_heads.OPTIONS.but(windows=(0.5,))
    aligned = jaxfit.train(heads[:12], AFLW21, method="alignment3d", options=of_heads).model
    for each in (parametric, tuned, aligned):
        assert {leaf.dtype for leaf in jax.tree.leaves((each.cascade, each.aligned))} == {np.dtype("float32")}
        jaxfit.save(each, tmp_path / "model.safetensors")
    loaded = jaxfit.load(tmp_path / "model.safetensors")
    assert jaxfit.fit(loaded, [face.image for face in heads[:2]], start_boxes(heads[:2])).fitted.all()
    assert jaxfit.evaluate(tuned, faces, start_boxes(faces), normaliser="box").fits.fitted.all()
    jaxfit.export.export_model(tuned, tmp_path / "programs.safetensors")
    exported = jaxfit.export.load_exported(tmp_path / "programs.safetensors")
    assert exported.outputs["landmarks"]["dtype"] == "float32"
    side = tuned.cascade.frame.crop
    assert exported(np.zeros((1, side, side), np.uint8))["landmarks"].dtype == np.float32


def test_crops_of_other_libraries_are_refused_by_name(drawn_model: Path) -> None:
    tensor = type("Tensor", (), {"__module__": "torch", "shape": (1, 64, 64)})()
    with pytest.raises(InputError, match=r"array of NumPy or JAX.*got torch\.Tensor"):
        _require_crops(jaxfit.load(drawn_model).cascade, tensor, 1)


def test_a_forked_process_is_told_instead_of_hanging(drawn_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = jaxfit.load(drawn_model)
    crops = jax.numpy.zeros((1, 64, 64), jax.numpy.uint8)
    monkeypatch.setattr(modes, "_first", os.getpid() + 1)  # as a child finds it that was forked
    for work in (
        lambda: jaxfit.load(drawn_model),
        lambda: jaxfit.fit(model, [np.zeros((64, 64), np.uint8)], [[10.0, 10.0, 40.0, 40.0]]),
        lambda: jaxfit.cascade.fit_crops(model.cascade, crops),
        lambda: jaxfit.warm_up(model, [1]),
    ):
        with pytest.raises(ProcessError, match=r'forked.*get_context\("spawn"\)'):
            work()


def test_a_real_fork_ends_with_a_sentence(drawn_model: Path) -> None:
    code = (
        "import jaxfit, os, sys\n"
        f"model = jaxfit.load({str(drawn_model)!r})\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    try:\n"
        "        jaxfit.warm_up(model, [1])\n"
        "    except jaxfit.JaxfitError as error:\n"
        "        os._exit(7)\n"
        "    os._exit(0)\n"
        "sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 7, ran.stderr


def test_a_fork_after_others_have_computed_ends_with_a_sentence(drawn_model: Path) -> None:
    code = (
        "import jax.numpy, jaxfit, os, sys\n"
        "jax.numpy.zeros(3) + 1\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    try:\n"
        f"        jaxfit.load({str(drawn_model)!r})\n"
        "    except jaxfit.errors.ProcessError as error:\n"
        "        os._exit(7)\n"
        "    os._exit(0)\n"
        "sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 7, ran.stderr


@pytest.mark.parametrize(
    "setting",
    ["JAX_ENABLE_X64=maybe", "JAX_DEFAULT_MATMUL_PRECISION=foo", "JAX_DEFAULT_DEVICE=foo", "JAX_NUM_CPU_DEVICES=two"],
)
def test_settings_that_jax_refuses_are_one_sentence(setting: str) -> None:
    name, _, value = setting.partition("=")
    expected = re.compile(rf"JAX cannot be imported: .*{value}.*; the environment sets .*{setting}.*: correct them")
    for words, code in ((["-m", "jaxfit", "models"], 2), (["-c", "import jaxfit"], 1)):
        environment = os.environ | {name: value}
        ran = subprocess.run(
            [sys.executable, *words], capture_output=True, text=True, env=environment, timeout=120, check=False
        )
        assert ran.returncode == code
        assert expected.search(ran.stderr.splitlines()[-1]), ran.stderr
        assert len(ran.stderr.splitlines()) == 1 or code == 1


@pytest.mark.parametrize("platform", ["nosuch", "cuda", "tpu"])
def test_a_platform_that_is_not_there_is_one_sentence(platform: str, drawn_model: Path, tmp_path: Path) -> None:
    request = ["fit", str(tmp_path), "--model", str(drawn_model), "--out", str(tmp_path / "out")]
    command = [sys.executable, "-m", "jaxfit", *request]
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    environment = os.environ | {"JAX_PLATFORMS": platform}
    ran = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert ran.returncode == 2
    (said,) = [line for line in ran.stderr.splitlines() if line.startswith("jaxfit: error:")]
    assert f"JAX cannot compute on '{platform}', which JAX_PLATFORMS" in said
    assert "Traceback" not in ran.stderr
