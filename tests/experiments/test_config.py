"""Configurations: what a file says is what is run; mistakes in it are reported."""

import time
import tomllib
from pathlib import Path
from typing import Any

import pytest

from jaxfit.descriptors import DESCRIPTORS
from jaxfit.descriptors.sift import Sift
from jaxfit.errors import InputError
from jaxfit.experiments.config import config_from, read_config
from jaxfit.experiments.names import folder_names
from jaxfit.learning.methods import view_of

TEXT = """
folds = 3
augmentations = [1, 4]
initialisations = [1, 3]
normaliser = "box"
seed = 7
[chosen]
augmentations = 4
steps = 2
[training]
windows = [0.5, 0.3]
mirror = false
descriptor = {normalisation = "cell"}
frame = {crop = 64, face = 36}
[datasets.faces]
data = ["pts:a", "pts:b"]
scheme = "aflw21"
thesis = "AFLW"
[methods.sdm]
[methods.narrow]
method = "parametric"
sigmas = 3
[methods.regression3d]
[pose]
train = ["pts:a"]
test = ["pointing04:c"]
"""


def changed(old: str, new: str) -> dict[str, Any]:
    assert old in TEXT
    return tomllib.loads(TEXT.replace(old, new))


def test_says_what_is_run() -> None:
    config = config_from(tomllib.loads(TEXT))
    assert (config.folds, config.steps, config.chosen_steps, config.seed) == (3, 2, 2, 7)
    assert config.augmentations == (1, 4)
    (faces,) = config.datasets
    assert (faces.data, faces.scheme, faces.thesis) == (("pts:a", "pts:b"), "aflw21", "AFLW")
    narrow = config.method("narrow")
    options = narrow.options
    assert (narrow.method, options.sigmas, options.mirror, options.greedy.seed) == ("parametric", 3.0, False, 7)
    assert config.pose is not None
    assert config.pose.test == ("pointing04:c",)


def test_methods_keep_their_own_descriptor_where_a_part_of_it_is_set_for_all() -> None:
    config = config_from(tomllib.loads(TEXT))
    described = {plan.name: plan.options.descriptor for plan in config.methods}
    assert described["sdm"] == Sift("upright", normalisation="cell")
    assert {described["narrow"], described["regression3d"]} == {Sift("face", normalisation="cell")}


@pytest.mark.parametrize("text", [TEXT, TEXT.split("[pose]")[0]])
def test_json_of_it_makes_the_same(text: str) -> None:
    config = config_from(tomllib.loads(text))
    assert config_from(config.as_json()) == config


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("folds = 3", "fold = 3", "unknown key 'fold'; expected some of augmentations"),
        ("folds = 3", 'folds = "3"', "folds: expected something like 10; got '3'"),
        ("folds = 3", "folds = 1", "folds: expected 2 or more; got 1"),
        ("augmentations = 4", "augmentations = 5", r"\[chosen\]: expected augmentations among \[1, 4\]"),
        ("steps = 2", "steps = 3", "steps from 1 to 2"),
        ("[0.5, 0.3]", "[0.5, -0.3]", r"\[training\]: expected at least one step, windows > 0"),
        ("sigmas = 3", "windows = [0.4]", r"\[methods.narrow\] windows: expected as many, .*; got 1, and 2 for sdm"),
        ("sigmas = 3", "sigma = 3", r"\[methods.narrow\] unknown key 'sigma'"),
        ('method = "parametric"', 'metod = "parametric"', r"\[methods.narrow\] unknown key 'metod'"),
        ('"parametric"', '"ert"', "expected method = one of sdm, parametric"),
        ("[methods.sdm]", "[methods.'a/b']\nmethod = 'sdm'", "it goes into file names"),
        ("initialisations = [1, 3]", "initialisations = [1, 2]", "one, or three or more, each"),
        ('"box"', '"nose"', "normaliser: expected one of outer, pupil, box"),
        ('thesis = "AFLW"', 'thesis = "COFW"', "thesis: expected one of AFLW, LFPW"),
        ('"aflw21"', '"aflw19"', r"\[datasets.faces\] scheme: "),
        ('["pts:a", "pts:b"]', '"pts:a"', 'data: expected a list of "FORMAT:PATH"'),
        ("[methods.regression3d]", "", "expected a 3D method among the methods"),
        ("augmentations = [1, 4]", "augmentations = [1, 4, 4]", "augmentations: expected each once"),
        ("initialisations = [1, 3]", "initialisations = [3, 3]", "initialisations: expected each once"),
        ("[methods.sdm]", "[methods.sdm]\n[methods.SDM]\nmethod = 'sdm'", r"\[methods\]: two are called SDM"),
        (
            "[methods.sdm]",
            "[methods.sdm]\n[methods.b-sdm]\nmethod = 'sdm'\n[datasets.faces-b]\ndata = ['pts:c']",
            "joined by '-': two are called faces-b-sdm",
        ),
        ('"pointing04:c"', '"pointing:c"', r"\[pose\] test: expected a dataset as .* one of pts, .*; got .pointing:c"),
        ("[methods.sdm]", "[methods]\nsdm = 3", r"expected a table, \[methods.sdm\]; got sdm = 3"),
        ("sigmas = 3", "sigmas = 'x'", r"\[methods.narrow\] sigmas: expected a number; got 'x'"),
        (
            '{normalisation = "cell"}',
            '{kind = "hog"}',
            "descriptor.kind: expected a descriptor among sift, .*; got 'hog'",
        ),
    ],
)
def test_mistakes_are_reported(old: str, new: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        config_from(changed(old, new))


def test_a_rank_is_a_whole_number() -> None:
    config = config_from(changed("sigmas = 3", "rank = 24"))
    rank = config.method("narrow").options.greedy.rank
    assert (rank, type(rank)) == (24, int)
    assert config_from(config.as_json()) == config
    with pytest.raises(InputError, match=r"rank: expected something like 0; got 2\.5"):
        config_from(changed("sigmas = 3", "rank = 2.5"))


def test_most_has_defaults() -> None:
    config = config_from(tomllib.loads("[datasets.faces]\ndata = ['pts:a']\n[methods.sdm]"))
    assert config.chosen_steps == config.steps == len(config.methods[0].options.greedy.windows)
    assert config_from(config.as_json()) == config


def test_descriptors_of_other_kinds() -> None:
    for kind, made in DESCRIPTORS.items():
        config = config_from(changed('{normalisation = "cell"}', f'{{kind = "{kind}"}}'))
        assert {type(plan.options.descriptor) for plan in config.methods} == {made}
        assert config_from(config.as_json()) == config
        turns = {plan.name: view_of(plan.method, plan.options)[0].turns for plan in config.methods}
        assert turns == {name: name != "sdm" for name in turns}
        # The crops suit it, too, unless they are given.
        config = config_from(
            {"datasets": {"a": {"data": ["pts:a"]}}, "methods": {"sdm": {"descriptor": {"kind": kind}}}}
        )
        assert view_of("sdm", config.method("sdm").options)[1] == made().frame
    # A part of the usual one.
    sdm = config_from(changed('{normalisation = "cell"}', '{kind = "sift", normalisation = "cell"}')).method("sdm")
    assert sdm == config_from(tomllib.loads(TEXT)).method("sdm")


def test_files_that_are_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_config(tmp_path / "nothing.toml")
    path = tmp_path / "torn.toml"
    path.write_text("folds = [")
    with pytest.raises(InputError, match=r"torn\.toml: is not TOML"):
        read_config(path)
    path.write_text(TEXT.replace("folds = 3", "folds = 1"))
    with pytest.raises(InputError, match=r"torn\.toml: folds: expected 2 or more"):
        read_config(path)


def test_the_documented_configuration_is_one() -> None:
    config = read_config(Path(__file__).resolve().parents[2] / "docs" / "measured" / "experiments" / "thesis.toml")
    assert {plan.name for plan in config.methods} == {"sdm", "parametric", "alignment3d", "regression3d"}
    assert {dataset.thesis for dataset in config.datasets} == {"AFLW", "LFPW"}
    assert config.names_thesis


def test_the_thesis_is_compared_with_only_where_a_dataset_names_it() -> None:
    assert config_from(tomllib.loads(TEXT)).names_thesis
    assert not config_from(changed('thesis = "AFLW"', "")).names_thesis


def test_folders_of_one_name_hold_other_people() -> None:
    assert folder_names(["a/train", "b/train/", "c", "a/train", "a//train"]) == [
        "train",
        "train-2",
        "c",
        *["train"] * 2,
    ]


@pytest.mark.parametrize(
    "text",
    ["a = " + 90_000 * "[", ".".join(50_000 * ["a"]) + " = 1", "a = " + 90_000 * "9", 200_000 * "#"],
    ids=["nested arrays", "dotted keys", "a long number", "a long file"],
)
def test_bombs_are_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.toml"
    path.write_text(text)
    begun = time.monotonic()
    with pytest.raises(InputError, match=r"bomb\.toml"):
        read_config(path)
    assert time.monotonic() - begun < 10
