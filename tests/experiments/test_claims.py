"""Claims are held against figures that are known to bear them out, or not."""

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jaxfit.evaluation.statistics import holm, rank_sum
from jaxfit.experiments.config import config_from
from jaxfit.experiments.results import DatasetResults, ExperimentResults, PoseResults
from jaxfit.experiments.thesis.claims import Claim, thesis_claims
from jaxfit.schemes.known import AFLW21

TEXT = """
folds = 2
augmentations = [1, 5, 10, 15]
initialisations = [1, 3]
[chosen]
augmentations = 15
steps = 6
[training]
windows = [0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3]
[datasets.faces]
data = ["pts:faces"]
thesis = "AFLW"
[methods.sdm]
[methods.parametric]
[methods.alignment3d]
[methods.regression3d]
"""
FACES = 200
METHODS = ("sdm", "parametric", "alignment3d", "regression3d")


def measured(thesis: str = "AFLW", flat: bool = False, **factors: float) -> ExperimentResults:
    """Results of errors that fall with steps and augmentations until 5 and 10 of them, unless ``flat``."""
    rng = np.random.default_rng(0)
    faces = rng.uniform(0.03, 0.08, FACES)
    falls = 1 + np.exp(-np.arange(7.0))[:, None] + np.exp(-np.array([0.0, 2.0, 4.0, 5.0]))[None, :]
    grid = {
        name: (np.ones((7, 4)) if flat else falls)[..., None] * faces * factors.get(name, 1.0)
        + rng.normal(0, 0.001, (7, 4, FACES))
        for name in METHODS
    }
    config = config_from(tomllib.loads(TEXT.replace('"AFLW"', f'"{thesis}"')))
    rise = {"sdm": 4.0, "parametric": 1.1}
    starts = {name: np.stack([of[5, 3], of[5, 3] * rise.get(name, 1.0)]) for name, of in grid.items()}
    seconds = {name: np.full(8, 0.02) + np.arange(8) * 1e-5 for name in METHODS}
    seconds["regression3d"] = seconds["regression3d"] / factors.get("speed", 2.0)
    people = np.array([f"person {number}" for number in range(FACES)])
    dataset = DatasetResults("faces", thesis, AFLW21, {"subject": people}, grid, starts, {}, {}, seconds, {})
    return ExperimentResults(config, (dataset,), (heads(**factors),), 1, 0, 0, 0.0, (), ())


def heads(people: float = 400, **factors: float) -> PoseResults:
    """Poses of 400 pictures that are found less well beyond 45 degrees."""
    rng = np.random.default_rng(1)
    yaw = rng.uniform(-90, 90, 400)
    truth = np.stack([np.zeros(400), rng.uniform(-30, 30, 400), yaw], 1)
    noise = rng.normal(0, 1, (400, 3)) * np.where(np.abs(yaw) > 45, factors.get("beyond", 5.0), 1.0)[:, None]
    fitted = {"alignment3d": truth + 4 * noise, "regression3d": truth + noise * factors.get("pose", 1.0)}
    return PoseResults("heads", truth, fitted, np.array([f"person {k % int(people)}" for k in range(400)]))


def of(results: ExperimentResults, letter: str) -> list[Claim]:
    found = [claim for claim in thesis_claims(results) if claim.letter == letter]
    assert found
    return found


def test_falling_errors_that_level_off() -> None:
    assert all(claim.holds for claim in of(measured(), "a"))
    assert len(of(measured(), "a")) == 2 * len(METHODS)
    assert not any(claim.holds for claim in of(measured(flat=True), "a"))


@pytest.mark.parametrize(
    ("thesis", "factor", "holds"),
    [("AFLW", 0.7, 1), ("AFLW", 1.0, 0), ("LFPW", 1.0, 1), ("LFPW", 0.96, 1), ("LFPW", 0.7, 0), ("LFPW", 1.1, 0)],
)
def test_parametric_against_sdm(thesis: str, factor: float, holds: int) -> None:
    (claim,) = of(measured(thesis, parametric=factor), "b")
    assert claim.holds == bool(holds)
    assert (claim.p is None) == (thesis == "LFPW")  # a p-value cannot show that errors are equal


def test_few_starts() -> None:
    (claim,) = of(measured(), "c")
    assert claim.holds
    assert "SDM 4.00, parametric 1.10" in claim.found


@pytest.mark.parametrize(("factors", "holds"), [({}, 1), ({"speed": 0.5}, 0), ({"regression3d": 1.2}, 0)])
def test_regression_is_faster_at_equal_error(factors: dict[str, Any], holds: int) -> None:
    (claim,) = of(measured(**factors), "d")
    assert claim.holds == bool(holds)


@pytest.mark.parametrize(("factor", "holds"), [(1.0, 1), (4.0, 0), (9.0, 0)])
def test_regression_has_the_better_pose(factor: float, holds: int) -> None:
    for claim in of(measured(pose=factor), "e"):
        assert claim.holds == bool(holds)


@pytest.mark.parametrize(("factor", "holds"), [(5.0, 1), (1.0, 0)])
def test_failing_beyond_45_degrees(factor: float, holds: int) -> None:
    for claim in of(measured(beyond=factor), "f"):
        assert claim.holds == bool(holds)


def test_too_little_shows_no_equality() -> None:
    results = measured("LFPW")
    (dataset,) = results.datasets
    rng = np.random.default_rng(2)
    grid = {name: of * rng.lognormal(0, 1.0, FACES) for name, of in dataset.grid.items()}
    noisy = replace(results, datasets=(replace(dataset, grid=grid),))
    (claim,) = of(noisy, "b")
    assert rank_sum(*(grid[name][5, 3] for name in ("sdm", "parametric"))) > 0.05
    assert claim.verdict != "holds"
    assert not any(claim.holds for claim in of(noisy, "d"))


def test_many_pictures_of_few_people_show_little() -> None:
    results = measured()
    habits = np.random.default_rng(3).normal(0, 8, (7, 3))
    few = heads(people=7)
    fitted = {name: np.tile(np.roll(habits, k, 0), (58, 1))[:400] + few.truth for k, name in enumerate(few.fitted)}
    for claim in of(replace(results, pose=(replace(few, fitted=fitted),)), "e"):
        assert "400 pictures of 7 subjects" in claim.where
        assert claim.p is not None
        assert claim.p > 0.1
    # What is so with all seven is seen all the same.
    assert all(claim.holds for letter in "ef" for claim in of(replace(results, pose=(few,)), letter))


def test_methods_are_known_by_what_they_are_not_by_their_names() -> None:
    text = TEXT.replace(
        "[methods.alignment3d]", '[methods.a]\nmethod = "regression3d"\n[methods.z]\nmethod = "alignment3d"'
    )
    pose = heads()
    renamed = {
        "z": pose.fitted["alignment3d"],
        "a": pose.fitted["regression3d"],
        "regression3d": pose.fitted["alignment3d"],
    }
    config = config_from(tomllib.loads(text))
    results = replace(measured(), config=config, datasets=(), pose=(replace(pose, fitted=renamed),))
    found = of(results, "e")
    assert [claim.claim[-5:] for claim in found] == ["pitch", "r yaw"]
    assert all(claim.holds and "z" in claim.found for claim in found)


def test_nothing_beyond_45_degrees_says_nothing_of_it() -> None:
    pose = heads()
    truth = pose.truth * [1, 1, 0.45]
    near = replace(pose, truth=truth, fitted={name: truth + 1 for name in pose.fitted})
    assert not [claim for claim in thesis_claims(replace(measured(), pose=(near,))) if claim.letter == "f"]


def test_claims_go_by_p_values_adjusted_for_all_tests_of_a_letter() -> None:
    found = thesis_claims(measured())
    assert [claim.letter for claim in found] == sorted(claim.letter for claim in found)
    for letter in "abcdef":
        same = [claim for claim in found if claim.letter == letter]
        adjusted = np.array([claim.adjusted for claim in same], float)
        np.testing.assert_allclose(adjusted, holm(np.array([claim.p for claim in same], float)))
    claim = replace(found[0], as_claimed=True, p=0.03, adjusted=0.06)
    assert not claim.holds
    assert replace(claim, adjusted=0.04).holds
    words = [
        replace(claim, adjusted=0.04),
        claim,
        replace(claim, as_claimed=False, adjusted=0.04),
        replace(claim, adjusted=None, sure=False),
    ]
    assert [each.verdict for each in words] == ["holds", "not shown", "does not hold", "not shown"]
