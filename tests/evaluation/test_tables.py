"""Tables: alignment, number formats and missing values."""

import numpy as np

from jaxfit.evaluation.tables import markdown_table, text_table

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
