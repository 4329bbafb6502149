"""CONTRIBUTING.md: its recipes are run, its files exist."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxfit
from jaxfit.data.detectors import DETECTORS
from jaxfit.data.writers import WRITERS
from jaxfit.descriptors import DESCRIPTORS, Descriptor
from jaxfit.evaluation import start_boxes
from jaxfit.labels.datasets import FORMATS
from jaxfit.learning.methods import METHODS
from jaxfit.schemes import AFLW21
from jaxfit.shapes import SPACES
from jaxfit.shapes.space import ShapeSpace

PAGE = (Path(__file__).resolve().parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
RECIPES = {
    re.sub(r"\W", "", title): code
    for title, code in re.findall(r"### An? ([\w ]+)\n.*?```python\n(.*?)```", PAGE, re.S)
}


@pytest.fixture
def cook() -> Iterator[Callable[[str], dict[str, Any]]]:
    """Runs a recipe; what it registers is forgotten afterwards."""
    registries: list[Any] = [SPACES, METHODS, DESCRIPTORS, FORMATS, WRITERS, DETECTORS]
    before = [dict(registry) for registry in registries]

    def run(name: str) -> dict[str, Any]:
        # A module of its own, as dataclasses look up where they were made.
        made: dict[str, Any] = {"__name__": "jaxfit"}
        exec(compile(RECIPES[name], f"CONTRIBUTING.md: {name}", "exec", dont_inherit=True), made)
        return made

    yield run
    for registry, known in zip(registries, before, strict=True):
        registry.clear()
        registry.update(known)


def fitted(heads: tuple, tmp_path: Path, **how: Any) -> float:
    """The mean error, in pixels, of a model that was trained on drawn heads, saved, loaded, and fits them."""
    from drawn_heads import OPTIONS

    method = how.pop("method", "sdm")
    model = jaxfit.train(heads, AFLW21, method=method, options=OPTIONS.but(**how)).model
    jaxfit.save(model, tmp_path / "model.safetensors")
    model = jaxfit.load(tmp_path / "model.safetensors")
    fits = jaxfit.fit(model, [face.image for face in heads], start_boxes(heads))
    truth = np.stack([face.landmarks for face in heads])
    return float(np.linalg.norm(fits.landmarks - truth, axis=-1).mean())


def test_a_shape_space(cook: Callable, heads: tuple, tmp_path: Path) -> None:
    made = cook("shapespace")
    mean = np.array([[-10.0, -10.0], [10.0, -10.0], [0.0, 12.0]], np.float32)
    assert isinstance(made["RigidSpace"](mean - mean.mean(0)), ShapeSpace)
    assert fitted(heads, tmp_path, method="rigid") < 6


def test_a_descriptor(cook: Callable, heads: tuple, tmp_path: Path) -> None:
    made = cook("descriptor")
    assert isinstance(made["Patch"](), Descriptor)
    assert fitted(heads, tmp_path, descriptor=made["Patch"]()) < 6


def test_a_dataset(cook: Callable, heads: tuple, tmp_path: Path) -> None:
    cook("dataset")
    file = heads[0].image.parent / "faces.json"
    entries = [{"image": face.image.name, "points": face.landmarks.tolist()} for face in heads]
    file.write_text(json.dumps(entries), encoding="utf-8")
    dataset = jaxfit.read_dataset(f"points-json:{file}")
    assert dataset.scheme == AFLW21
    np.testing.assert_allclose([face.landmarks for face in dataset.faces], [face.landmarks for face in heads])
    with pytest.raises(jaxfit.errors.DatasetError, match="expected a JSON file"):
        jaxfit.read_dataset(f"points-json:{tmp_path / 'none.json'}")


def test_a_writer_and_a_detector(cook: Callable, heads: tuple, tmp_path: Path) -> None:
    cook("writer")
    cook("detector")
    run = jaxfit.FolderRun(
        tmp_path, model="face21", fitting=jaxfit.Fitting("middle"), formats=("counts",), overlays=False
    )
    report = jaxfit.fit_folder(run, [face.image for face in heads[:3]])
    assert report.faces == 3
    lines = (tmp_path / "counts.txt").read_text(encoding="utf-8").splitlines()
    assert lines == [f"1 {face.image}" for face in heads[:3]]


def test_all_recipes_are_tried() -> None:
    assert sorted(RECIPES) == ["dataset", "descriptor", "detector", "shapespace", "writer"]


def test_the_walk_is_short_and_its_files_exist() -> None:
    walk = PAGE.partition("## From")[2].partition("## Recipes")[0]
    steps = re.findall(r"^\d+\. ", walk, re.M)
    assert 0 < len(steps) <= 12
    names = re.findall(r"`((?:\w+/)+(?:\w+\.py)?)`", walk)
    assert len(names) > 10
    for name in names:
        assert (Path(jaxfit.__file__).parent / name).exists(), name
