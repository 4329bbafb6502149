"""Tables as LaTeX, for papers."""

import re
from collections.abc import Iterable

from jaxfit.evaluation.tables import format_cells, is_numeric
from jaxfit.experiments.report_parts import ReportTable

# Characters that LaTeX reads as something else, or lacks in its default fonts.
_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "°": r"$^\circ$",
    "±": r"$\pm$",
    "×": r"$\times$",
    "·": r"$\cdot$",
    "−": r"$-$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "∞": r"$\infty$",
    "√": r"$\surd$",
    "σ": r"$\sigma$",
    "→": r"$\rightarrow$",
    "†": r"$\dagger$",
}


def latex_table(table: ReportTable) -> str:
    """The table as a ``tabular`` with the rules of the package booktabs; columns of numbers are flush right."""
    numeric = [is_numeric(table.rows, heading) for heading in table.columns]
    lines = [
        f"% {' '.join(table.title.split())}",
        r"% Needs \usepackage{booktabs}.",
        rf"\begin{{tabular}}{{{''.join('r' if right else 'l' for right in numeric)}}}",
        r"\toprule",
        _line(map(_escaped, table.columns)),
        r"\midrule",
        *(
            _line(_number(cell) if right else _escaped(cell) for cell, right in zip(cells, numeric, strict=True))
            for cells in format_cells(table.rows, table.columns)
        ),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _line(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in " ".join(text.split()))


def _number(cell: str) -> str:
    """A formatted number; a missing one, ``-``, becomes a dash, and a hyphen before a number a minus sign."""
    if cell == "-":
        return "--"
    return re.sub("^-", "$-$", _escaped(cell).replace("inf", r"$\infty$"))
