"""What a report says of made-up poses: people count, not pictures; of the thesis it speaks only if it is asked to."""

import tomllib
from typing import Any

import numpy as np
import pytest
from report_words import check_is_the_same_without_the_thesis

from jaxfit.evaluation.pose import pose_rows
from jaxfit.evaluation.statistics import holm
from jaxfit.experiments.config import config_from
from jaxfit.experiments.report import build_report
from jaxfit.experiments.report_parts import Report, ReportFigure, ReportTable
from jaxfit.experiments.results import ExperimentResults, PoseResults
from jaxfit.experiments.thesis.numbers import THESIS

# Under names of their own, and one that finds nothing.
TEXT = """
[datasets.faces]
data = ["pts:a"]
thesis = "AFLW"
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


def report_of(text: str) -> Report:
    pytest.importorskip("matplotlib")
    return build_report(ExperimentResults(config_from(tomllib.loads(text)), (), (poses(),), 1, 0, 0, 0.0, (), ()))


@pytest.fixture(scope="module")
def report() -> Report:
    return report_of(TEXT)


def table(report: Report, name: str) -> ReportTable:
    (found,) = (part for section in report.sections for part in section.parts if part.name == name)
    assert isinstance(found, ReportTable)
    return found


def rows_by(found: ReportTable, *headings: str) -> dict[tuple[object, ...], dict[str, Any]]:
    return {tuple(row[heading] for heading in headings): dict(row) for row in found.rows}


def test_errors_of_pose(report: Report) -> None:
    found, pose = table(report, "pose-pointing04"), poses()
    assert found.title.startswith("Table 7. ")
    assert f"{len(pose.truth)} pictures of {PEOPLE} subjects" in found.note
    assert report.about["poses"] in found.note
    rows = rows_by(found, "method", "range", "angle")
    (expected,) = (
        row
        for row in pose_rows(pose.fitted["aligned"], pose.truth, pose.subjects)
        if (row["range"], row["angle"]) == ("all", "yaw")
    )
    row = rows["aligned", "all", "yaw"]
    assert {key: row[key] for key in expected} == expected
    assert row["thesis"] == THESIS["pose"]["alignment3d"]["yaw"][0]
    assert row["ratio to the thesis"] == pytest.approx(row["MAE"] / row["thesis"])
    assert rows["regressed", "all", "pitch"]["thesis"] == THESIS["pose"]["regression3d"]["pitch"][0]


def test_tests_of_pose(report: Report) -> None:
    found = table(report, "pose-tests-pointing04")
    assert len(found.rows) == 2 * 3  # roll is unknown
    rows = rows_by(found, "methods", "angle")
    row = rows["aligned, regressed", "yaw"]
    assert row["thesis's rank-sum p"] == THESIS["pose_p"]["yaw"]
    assert row["rank-sum p"] < 1e-10
    assert row["signed-rank p"] == pytest.approx(2 / 2**PEOPLE)  # all seven differ the same way
    adjusted = holm(np.array([row["signed-rank p"] for row in rows.values()]))
    assert [row["signed-rank p (Holm)"] for row in rows.values()] == pytest.approx(adjusted.tolist())
    assert row["difference of means"] < -0.3
    assert np.isnan(rows["aligned, lost", "yaw"]["difference of means"])
    assert np.isnan(rows["regressed, lost", "yaw"]["thesis's rank-sum p"])  # the thesis compares no such two
    assert {claim["here"] for claim in table(report, "claims").rows if claim[""] == "e"} == {"holds"}


def test_errors_by_true_pose(report: Report) -> None:
    found = table(report, "pose-pointing04-regressed-yaw")
    assert [row["pitch \\ yaw"] for row in found.rows] == THESIS["pitches"]
    known = np.array([[row[f"{yaw:g} (thesis)"] for yaw in THESIS["yaws"]] for row in found.rows])
    np.testing.assert_array_equal(known, np.array(THESIS["pose_grid"]["regression3d"]["yaw"], float))
    assert "times the thesis's" in found.note
    figures = {
        part.name: part.title for section in report.sections for part in section.parts if isinstance(part, ReportFigure)
    }
    assert figures.keys() == {"surface-pointing04-aligned", "surface-pointing04-regressed"}  # nothing of the lost
    assert figures["surface-pointing04-regressed"].startswith("Figure 21. ")


def test_without_a_dataset_of_the_thesis_nothing_is_said_of_it(report: Report) -> None:
    check_is_the_same_without_the_thesis(report, report_of(TEXT.replace('thesis = "AFLW"\n', "")))
