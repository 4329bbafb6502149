"""Claims are held against figures that are known to bear them out, or not."""

import tomllib

import numpy as np
import pytest

from jaxfit.evaluation.statistics import holm
from jaxfit.experiments.claims import Claim, claims
from jaxfit.experiments.config import config_from
from jaxfit.experiments.results import DatasetResults, PoseResults, Results
from jaxfit.shapes.schemes import AFLW21

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


def measured(thesis: str = "AFLW", flat: bool = False, **factors: float) -> Results:
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
    dataset = DatasetResults("faces", thesis, AFLW21, {}, grid, starts, {}, seconds, {})
    yaw = rng.uniform(-90, 90, 400)
    truth = np.stack([np.zeros(400), rng.uniform(-30, 30, 400), yaw], 1)
    noise = rng.normal(0, 1, (400, 3)) * np.where(np.abs(yaw) > 45, factors.get("beyond", 5.0), 1.0)[:, None]
    fitted = {"alignment3d": truth + 4 * noise, "regression3d": truth + noise * factors.get("pose", 1.0)}
    return Results(config, (dataset,), (PoseResults("heads", truth, fitted),), 1, 0, 0.0, (), ())


def of(results: Results, letter: str) -> list[Claim]:
    found = [claim for claim, _ in claims(results) if claim.letter == letter]
    assert found
    return found


def test_falling_errors_that_level_off() -> None:
    assert all(claim.holds for claim in of(measured(), "a"))
    assert len(of(measured(), "a")) == 2 * len(METHODS)
    assert not any(claim.holds for claim in of(measured(flat=True), "a"))


@pytest.mark.parametrize(
    ("thesis", "factor", "holds"), [("AFLW", 0.7, 1), ("AFLW", 1.0, 0), ("LFPW", 1.0, 1), ("LFPW", 0.7, 0)]
)
def test_parametric_against_sdm(thesis: str, factor: float, holds: int) -> None:
    (claim,) = of(measured(thesis, parametric=factor), "b")
    assert claim.holds == bool(holds)


def test_few_starts() -> None:
    (claim,) = of(measured(), "c")
    assert claim.holds
    assert "SDM 4.00, parametric 1.10" in claim.found


@pytest.mark.parametrize(("factors", "holds"), [({}, 1), ({"speed": 0.5}, 0), ({"regression3d": 1.2}, 0)])
def test_regression_is_faster_at_equal_error(factors: dict, holds: int) -> None:
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


def test_p_values_are_adjusted_for_all_claims() -> None:
    found = claims(measured())
    np.testing.assert_allclose([p for _, p in found], holm(np.array([claim.p for claim, _ in found])))
