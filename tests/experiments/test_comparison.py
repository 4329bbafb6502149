"""The report of a comparison: its tables say what was measured, and its page fits a desktop and a telephone."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from jaxfit.data.outputs import write_csv
from jaxfit.evaluation.compare import Comparison, plan_comparison, read_contestants
from jaxfit.evaluation.datasets import EvaluationRun
from jaxfit.evaluation.statistics import holm, rank_biserial, signed_rank
from jaxfit.experiments.comparison import build_comparison, comparison_tables
from jaxfit.experiments.page import write_files

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

PEOPLE, EACH = 12, 3
POINTS = [f"{axis}{number}" for number in range(1, 69) for axis in "xy"]
POSE = ["roll", "pitch", "yaw"]
SPREADS = {"good": 1.0, "bad": 4.0, "none": 1.0}  # pixels of noise; the last one misses most faces


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """Three programs' fits of faces of several people, who look to either side."""
    folder = tmp_path_factory.mktemp("compared")
    rng = np.random.default_rng(0)
    shape = rng.uniform(20, 80, (68, 2))
    labels: list[list[object]] = []
    found: dict[str, list[list[object]]] = {name: [] for name in SPREADS}
    for number in range(PEOPLE * EACH):
        name = f"face{number:02}.png"
        cv2.imwrite(str(folder / name), rng.integers(0, 255, (100, 100), np.uint8))
        points, pose = shape + rng.normal(0, 2, (68, 2)), np.array([0.0, 5.0, number * 3.0 - 52])
        labels.append([name, f"person {number % PEOPLE}", *points.ravel(), *pose])
        for program, spread in SPREADS.items():
            if program != "none" or number < 4:
                noisy = points + rng.normal(0, spread, (68, 2))
                found[program].append([name, *noisy.ravel(), *(pose + rng.normal(0, spread, 3))])
    write_csv(folder / "labels.csv", ["image", "subject", *POINTS, *POSE], labels)
    for program, rows in found.items():
        write_csv(folder / f"{program}.csv", ["image", *POINTS, *POSE], rows)
    contestants = read_contestants([str(folder / f"{program}.csv") for program in SPREADS])
    run = EvaluationRun(normaliser="area")
    (comparison,) = plan_comparison(contestants, [f"csv:{folder / 'labels.csv'}"], run).compare()
    return comparison


def test_tables_say_who_is_better_and_how_sure_that_is(compared: Comparison) -> None:
    tables = {table.name: table for table in comparison_tables([compared])}
    rows_of: dict[str, Any] = {name: table.rows for name, table in tables.items()}
    assert list(tables) == ["errors", "intervals", "tests", "by-yaw", "poses", "pose-tests"]
    errors = {str(row["contestant"]): row for row in rows_of["errors"]}
    assert [row["no fit"] for row in errors.values()] == [0, 0, PEOPLE * EACH - 4]
    assert {row["relative to"] for row in errors.values()} == {"√(width × height) of the bounding box"}
    shared = np.isfinite(compared.errors["none"])
    assert errors["bad"]["mean of shared"] == pytest.approx(compared.errors["bad"][shared].mean())
    rows = rows_of["tests"]
    expected = [
        signed_rank(compared.errors[row["second"]], compared.errors[row["first"]], compared.subjects) for row in rows
    ]
    np.testing.assert_allclose([row["signed-rank p"] for row in rows], expected)
    np.testing.assert_allclose([row["signed-rank p (Holm)"] for row in rows], holm(np.array(expected)))
    assert [row["better"] for row in rows] == ["good", "good", "bad"]
    assert rows[0]["effect size"] == rank_biserial(compared.errors["bad"], compared.errors["good"], compared.subjects)
    means = rows_of["by-yaw"][0]
    yaws = np.abs(compared.true_pose[:, 2])
    assert means["0 to 30°"] == pytest.approx(compared.errors["good"][yaws <= 30].mean())
    assert means["60 to 90°"] is None or np.isnan(means["60 to 90°"])
    for row in rows_of["poses"]:
        assert row["MAE from"] < row["MAE"] < row["MAE to"] or row["faces"] - row["no fit"] < 2
    for table in tables.values():
        assert all({*row} <= {*table.columns} for row in table.rows)


@pytest.fixture(scope="module")
def page(compared: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    written = write_files(build_comparison([compared], ["good: <script>alert(1)</script>"]), folder)
    assert all((folder / name).stat().st_size > 0 for name in written)
    assert {f"figures/{name}-labels-csv.svg" for name in ("ced", "yaw", "pose-yaw", "worst")} <= {*written}
    assert {"tables/tests.csv", "tables/tests.tex", "tables/poses.csv"} <= {*written}
    return folder / "report.html"


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_fits_desktops_and_telephones(browser: Any, page: Path, width: int) -> None:
    opened = browser.new_page(viewport={"width": width, "height": 900})
    problems: list[str] = []
    opened.on("console", lambda message: problems.append(message.text))
    opened.on("pageerror", lambda error: problems.append(str(error)))
    requests: list[str] = []
    opened.on("request", lambda request: requests.append(request.url))
    opened.goto(page.as_uri())
    assert opened.evaluate("document.documentElement.scrollWidth") == width
    assert opened.locator("table").count() == 6
    assert opened.locator(".drawing svg").count() == 4
    assert opened.get_by_text("<script>alert(1)</script>").count() == 1
    gallery = opened.locator(".gallery")
    gallery.scroll_into_view_if_needed()
    gallery.get_by_label("Method").select_option("bad")
    gallery.locator(".face svg").first.wait_for()
    assert gallery.locator(".face").count() == PEOPLE * EACH
    assert problems == []
    assert [url for url in requests if not url.startswith("data:")] == [page.as_uri()]
    opened.close()
