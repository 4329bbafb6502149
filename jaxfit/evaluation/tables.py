"""Tables of results: aligned plain text for terminals, Markdown for documents."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.statistics import Subjects, both_measured, rank_sum, signed_rank, summarise

Row = Mapping[str, object]

# The columns of a table of datasets or methods, whose rows ``summary_row`` makes.
SUMMARY_COLUMNS = {
    "faces": "d",
    "learned from": "d",
    "no fit": "d",
    "unmeasured": "d",
    "mean": ".4f",
    "± 95 %": ".4f",
    "median": ".4f",
    f"AUC@{LIMIT:g}": ".3f",
    f"failure@{LIMIT:g}": ".3f",
}

# The columns of a table of differences between methods, whose rows ``comparison_row`` makes.
COMPARISON_COLUMNS = {"faces": "d", "difference of medians": "+.1%", "rank-sum p": ".2g", "signed-rank p": ".2g"}


def summary_row(errors: np.ndarray, subjects: Subjects = None, learned: np.ndarray | None = None) -> dict[str, object]:
    """The row of ``SUMMARY_COLUMNS`` for errors (N,): the mean is over fitted faces, the last three count failures.

    ``learned`` (N,) says from which of the faces' pictures the model learned, on which it is no test: ``unknown`` if
    None.
    """
    summary = summarise(errors, subjects=subjects)
    counts = (
        summary.faces,
        "unknown" if learned is None else int(learned.sum()),
        summary.failed,
        summary.unmeasured,
    )
    values = (summary.mean, summary.ci95, summary.median, summary.auc, summary.failure)
    return dict(zip(SUMMARY_COLUMNS, counts + values, strict=True))


def comparison_row(errors: np.ndarray, baseline: np.ndarray, subjects: Subjects = None) -> dict[str, object]:
    """The row of ``COMPARISON_COLUMNS`` for errors (N,) of a method and a baseline's (N,) on the same faces.

    Faces that either could not measure (NaN) are left out; a failure (``inf``) is the worst of errors. The rank-sum
    test assumes that faces are independent; with ``subjects``, the signed-rank test pairs people.

    Raises:
        InputError: the errors are not vectors of one length, or there is not one subject a face.
    """
    paired_p = signed_rank(errors, baseline, subjects)
    errors, baseline = both_measured(errors, baseline)
    with np.errstate(divide="ignore", invalid="ignore"):  # medians of no face, of failures, or zero
        difference = float(np.divide(summarise(errors).median, summarise(baseline).median)) - 1
    values = (errors.size, difference, rank_sum(errors, baseline), paired_p)
    return dict(zip(COMPARISON_COLUMNS, values, strict=True))


def text_table(rows: Sequence[Row], columns: Mapping[str, str]) -> str:
    """Aligned plain text; columns of numbers are flush right.

    Args:
        rows: values by heading; a missing one, None or NaN shows as ``-``.
        columns: for each heading, in order, how its floats are formatted, such as ``.4f``; ``""`` for plain.
    """
    lines = [list(columns), *format_cells(rows, columns)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    formats = [f"{'>' if is_numeric(rows, name) else '<'}{width}" for name, width in zip(columns, widths, strict=True)]
    return "\n".join("  ".join(map(format, line, formats)).rstrip() for line in lines)


def markdown_table(rows: Sequence[Row], columns: Mapping[str, str]) -> str:
    """A Markdown table of the rows; see ``text_table`` for the arguments."""
    rules = ["---:" if is_numeric(rows, name) else "---" for name in columns]
    lines = [list(columns), rules, *format_cells(rows, columns)]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def format_cells(rows: Sequence[Row], columns: Mapping[str, str]) -> list[list[str]]:
    """The text of each cell, row by row; see ``text_table`` for the arguments."""
    return [[_cell(row.get(name), spec) for name, spec in columns.items()] for row in rows]


def is_numeric(rows: Sequence[Row], name: str) -> bool:
    """Whether a column holds nothing but numbers, or misses them."""
    values = [row.get(name) for row in rows]
    return all(value is None or isinstance(value, int | float | np.number) for value in values)


def _cell(value: object, spec: str) -> str:
    if isinstance(value, float | np.floating):
        return "-" if math.isnan(value) else format(float(value), spec)
    return "-" if value is None else str(value)
