"""A little of ``scripts/fuzz.py``: mutated input ends in jaxfit's own errors, whatever reads it."""

import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from script_runner import load

from jaxfit.errors import JaxfitError


@pytest.fixture(scope="module")
def fuzz() -> Any:
    return load("fuzz")


def test_mutations_differ_and_come_again(fuzz: Any) -> None:
    seeds = [bytes(range(256)) * 4, b"short"]
    made = [fuzz.mutated(seeds, np.random.default_rng([3, number])) for number in range(200)]
    assert made == [fuzz.mutated(seeds, np.random.default_rng([3, number])) for number in range(200)]
    assert len({*made}) > 150


TARGETS = "images exif names folders arrays pts aflw lfpw pointing04 aflw2000 boxes models heads configs videos page"


def test_all_targets_are_tried(fuzz: Any) -> None:
    assert TARGETS.split() == list(fuzz.TARGETS)


@pytest.mark.parametrize("name", TARGETS.split())
def test_mutated_input_is_read_or_refused(fuzz: Any, name: str, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        target = fuzz.TARGETS[name](tmp_path)
        assert all(target.attempt(data) == "read" for data in target.seeds)
        for number in range(25):
            with suppress(JaxfitError):
                target.attempt(fuzz.mutated(target.seeds, np.random.default_rng([99, number])))
        # Nothing of what was refused stays.
        assert all(target.attempt(data) == "read" for data in target.seeds)
