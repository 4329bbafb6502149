"""What a report says of poses that are made up: the thesis's numbers stand beside, and people count, not pictures."""

import tomllib

import numpy as np
import pytest

from jaxfit.evaluation.pose import pose_rows
from jaxfit.evaluation.statistics import holm
from jaxfit.experiments.config import config_from
from jaxfit.experiments.document import Document, Figure, Table
from jaxfit.experiments.report import document
from jaxfit.experiments.results import PoseResults, Results
from jaxfit.experiments.thesis import THESIS

# Under names of their own, and one that finds nothing.
TEXT = """
[methods.aligned]
method = "alignment3d"
[methods.regressed]
method = "regression3d"
[methods.lost]
method = "regression3d"
[pose]
train = ["pts:a"]
test = ["pointing04:b"]
"""
PEOPLE = 7


def poses() -> PoseResults:
    """Pointing'04's poses of seven people, who are found more or less well."""
    grid = [(tilt, pan) for tilt in THESIS["pitches"] if abs(tilt) < 90 for pan in THESIS["yaws"]]
    series = np.array([(np.nan, *pose) for pose in [*grid, (-90, 0), (90, 0)]], float)
    truth = np.concatenate([series] * PEOPLE)
    people = np.repeat(np.arange(PEOPLE), len(series))
    rng = np.random.default_rng(0)
    off = np.nan_to_num(truth) + 1.5 * rng.normal(size=(PEOPLE, 3))[people] + rng.normal(size=truth.shape)
    fitted = {"aligned": off + 9, "regressed": off, "lost": np.full(truth.shape, np.nan)}
    return PoseResults("pointing04", truth, fitted, np.array([f"Person{number:02}" for number in people]))


@pytest.fixture(scope="module")
def report() -> Document:
    pytest.importorskip("matplotlib")
    return document(Results(config_from(tomllib.loads(TEXT)), (), (poses(),), 1, 0, 0, 0.0, (), ()))


def table(report: Document, name: str) -> Table:
    (found,) = (part for section in report.sections for part in section.parts if part.name == name)
    assert isinstance(found, Table)
    return found


def test_errors_of_pose(report: Document) -> None:
    found, pose = table(report, "pose-pointing04"), poses()
    assert found.title.startswith("Table 7. ")
    assert f"{len(pose.truth)} pictures of {PEOPLE} subjects" in found.note
    assert report.about["poses"] in found.note
    rows = {(row["method"], row["range"], row["angle"]): row for row in found.rows}
    (expected,) = (
        row
        for row in pose_rows(pose.fitted["aligned"], pose.truth, pose.subjects)
        if (row["range"], row["angle"]) == ("all", "yaw")
    )
    row = rows["aligned", "all", "yaw"]
    assert {key: row[key] for key in expected} == expected
    assert row["thesis"] == THESIS["pose"]["alignment3d"]["yaw"][0]
    assert row["ratio to the thesis"] == pytest.approx(expected["MAE"] / row["thesis"])
    assert rows["regressed", "all", "pitch"]["thesis"] == THESIS["pose"]["regression3d"]["pitch"][0]


def test_tests_of_pose(report: Document) -> None:
    found = table(report, "pose-tests-pointing04")
    assert len(found.rows) == 2 * 3  # roll is unknown
    rows = {(row["methods"], row["angle"]): row for row in found.rows}
    row = rows["aligned, regressed", "yaw"]
    assert row["thesis's rank-sum p"] == THESIS["pose_p"]["yaw"]
    assert row["rank-sum p"] < 1e-10
    assert row["signed-rank p"] == pytest.approx(2 / 2**PEOPLE)  # all seven differ the same way
    adjusted = holm(np.array([row["signed-rank p"] for row in found.rows]))
    assert [row["signed-rank p (Holm)"] for row in found.rows] == pytest.approx(adjusted.tolist())
    assert row["difference of means"] < -0.3
    assert np.isnan(rows["aligned, lost", "yaw"]["difference of means"])
    assert np.isnan(rows["regressed, lost", "yaw"]["thesis's rank-sum p"])  # the thesis compares no such two
    assert {claim["here"] for claim in table(report, "claims").rows if claim[""] == "e"} == {"holds"}


def test_errors_by_true_pose(report: Document) -> None:
    found = table(report, "pose-pointing04-regressed-yaw")
    assert [row["pitch \\ yaw"] for row in found.rows] == THESIS["pitches"]
    known = np.array([[row[f"{yaw:g} (thesis)"] for yaw in THESIS["yaws"]] for row in found.rows])
    np.testing.assert_array_equal(known, np.array(THESIS["pose_grid"]["regression3d"]["yaw"], float))
    assert "times the thesis's" in found.note
    figures = {
        part.name: part.title for section in report.sections for part in section.parts if isinstance(part, Figure)
    }
    assert figures.keys() == {"surface-pointing04-aligned", "surface-pointing04-regressed"}  # nothing of the lost
    assert figures["surface-pointing04-regressed"].startswith("Figure 21. ")
