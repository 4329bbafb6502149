"""Tables: alignment, number formats and missing values; comparisons of methods."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="arg-type"

import math

import numpy as np
import pytest

from jaxfit.errors import InputError
from jaxfit.evaluation.statistics import rank_sum, signed_rank
from jaxfit.evaluation.tables import COMPARISON_COLUMNS, comparison_row, markdown_table, text_table

ROWS = [
    {"method": "SDM", "faces": 836, "NMED": 0.07631, "p": None},
    {"method": "a|b", "faces": 9, "NMED": np.float32(0.1), "p": float("nan")},
    {"method": "3D regression", "NMED": float("inf"), "p": 0.5, "not shown": 1},
]
COLUMNS = {"method": "", "faces": "", "NMED": ".4f", "p": ".2g"}


def test_text() -> None:
    assert text_table(ROWS, COLUMNS).splitlines() == [
        "method         faces    NMED    p",
        "-------------  -----  ------  ---",
        "SDM              836  0.0763    -",
        "a|b                9  0.1000    -",
        "3D regression      -     inf  0.5",
    ]


def test_markdown() -> None:
    assert markdown_table(ROWS, COLUMNS).splitlines() == [
        "| method | faces | NMED | p |",
        "| --- | ---: | ---: | ---: |",
        "| SDM | 836 | 0.0763 | - |",
        "| a\\|b | 9 | 0.1000 | - |",
        "| 3D regression | - | inf | 0.5 |",
    ]


def test_no_rows_leave_the_headings() -> None:
    assert text_table([], {"method": ""}) == "method\n------"
    assert markdown_table([], {"method": ""}) == "| method |\n| ---: |"


def test_comparisons_leave_out_what_either_cannot_measure_and_count_failures() -> None:
    rng = np.random.default_rng(0)
    baseline = rng.uniform(0.02, 0.1, 30)
    errors = baseline * rng.uniform(0.7, 1.1, 30)
    errors[4] = np.inf
    measured = errors.copy(), baseline.copy()
    errors, baseline = np.append(errors, [np.nan, 0.01]), np.append(baseline, [0.9, np.nan])
    row = comparison_row(errors, baseline)
    difference = np.median(measured[0]) / np.median(measured[1]) - 1
    assert list(row) == list(COMPARISON_COLUMNS)
    assert list(row.values()) == [30, pytest.approx(difference), rank_sum(*measured), signed_rank(*measured)]


def test_comparisons_of_nothing_and_of_failures() -> None:
    for errors in (np.array([]), np.array([np.nan])):
        faces, *numbers = comparison_row(errors, errors).values()
        assert faces == 0
        assert np.isnan(numbers).all()
    failed = np.full(3, np.inf)
    assert math.isnan(comparison_row(failed, failed)["difference of medians"])
    assert comparison_row(failed, np.ones(3))["difference of medians"] == np.inf
    assert comparison_row(np.ones(3), failed)["difference of medians"] == -1


def test_comparisons_need_the_same_faces() -> None:
    with pytest.raises(InputError, match="same faces"):
        comparison_row(np.zeros(3), np.zeros(4))
