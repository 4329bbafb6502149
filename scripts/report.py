"""The report of a measuring script: Markdown that is printed as it comes, and a page with the command and the machine.

Scripts with one result write it with ``--report FILE.md``: figures replace what stands between two marks of the page,
so that the prose around them stays; parts that are measured one by one have marks of their own. Scripts that write a
folder have ``--out DIR`` instead, with a page in it.
"""

import argparse
import os
import platform
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxfit
from jaxfit.cli.arguments import out_folder
from jaxfit.cli.main import exit_code
from jaxfit.data.outputs import atomic_write
from jaxfit.errors import InputError
from jaxfit.evaluation.statistics import summarise
from jaxfit.evaluation.tables import Row, markdown_table
from jaxfit.labels.datasets import parse_spec
from jaxfit.labels.records import Dataset

# The columns of a table of errors, whose rows `error_row` makes.
ERROR_COLUMNS = {"median NMED": ".4f", "AUC": ".3f", "failures, %": ".1f"}

_END = "<!-- end of figures -->\n"


class Report:
    """What a script measured: paragraphs and tables in Markdown, in their order.

    Attributes:
        title: of a page that is new, or in a folder of results.
        parts: what was added so far, of this section.
    """

    def __init__(self) -> None:
        self.title = ""
        self.parts: list[str] = []
        self._sections = {"": self.parts}

    def begin(self, name: str) -> None:
        """Begin a section: what is added from here on stands between its own marks, ``<!-- figures: NAME -->``."""
        self.parts = self._sections.setdefault(name, [])

    def add(self, *parts: str) -> None:
        """Print and keep paragraphs, tables or headings."""
        for part in parts:
            print(f"{part}\n", flush=True)
        self.parts += parts

    def table(self, rows: Sequence[Row], columns: Mapping[str, str], above: str = "") -> None:
        """Add a table, with a paragraph above it; see ``jaxfit.evaluation.tables.markdown_table``."""
        self.add(*[above] * bool(above), markdown_table(rows, columns))

    def write(self, page: Path, whole: bool) -> None:
        """Write the page: ``whole``, or what stands between its marks."""
        title = f"# {self.title}\n\n" if self.title else ""
        figures = {
            name: "\n\n".join([f"```\n{command()}\n```", made_with(), *parts]) + "\n"
            for name, parts in self._sections.items()
            if parts
        }
        if whole:
            text = title + "\n".join(figures.values())
        else:
            text = page.read_text(encoding="utf-8") if page.exists() else title
            for name, of_section in figures.items():
                begin = f"<!-- figures: {name} -->\n" if name else "<!-- figures -->\n"
                before, _, rest = text.partition(begin)
                text = before + begin + of_section + _END + rest.partition(_END)[2]
        with atomic_write(page, "w") as file:
            file.write(text)


def script_parser(about: str | None, out: str = "") -> argparse.ArgumentParser:
    """A parser for a script with this docstring, with ``--report FILE.md``; or ``--out DIR`` for what ``out`` names."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    if out:
        parser.add_argument("--out", required=True, metavar="DIR", help=f"where {out} go")
    else:
        parser.add_argument("--report", metavar="FILE.md", help="replace the figures in this page, or write it")
    return parser


def measure(run: Callable[[argparse.Namespace, Report], int | None], arguments: argparse.Namespace) -> int:
    """Run a script, and write its report: the exit code."""

    def reported(arguments: argparse.Namespace) -> int:
        report, page = Report(), getattr(arguments, "report", None)
        if page and not Path(page).parent.is_dir():  # before hours of work
            raise InputError(f"--report: expected a file in a folder that exists; got {page}")
        code = run(arguments, report) or 0
        print(made_with())
        if page:
            report.write(Path(page), whole=False)
        elif getattr(arguments, "out", None):
            report.write(out_folder(arguments.out) / f"{Path(sys.argv[0]).stem}.md", whole=True)
        return code

    return exit_code(reported, arguments)


def save_figure(figure: Any, path: Path, dpi: int) -> None:
    """Write a figure of matplotlib's as a PNG, atomically."""
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=dpi)


def command() -> str:
    """The command line that made a report."""
    return shlex.join(["python", f"scripts/{Path(sys.argv[0]).name}", *sys.argv[1:]])


def made_with() -> str:
    """Versions and the machine: a sentence."""
    versions = [f"{module.__name__} {module.__version__}" for module in (jaxfit, jax, np)]
    rival = sys.modules.get("dlib")  # where a script uses it
    versions += [f"dlib {rival.__version__}"] if rival else []
    versions.append(f"Python {platform.python_version()}")
    machine = (platform.system(), platform.machine(), processor(), f"{cores()} cores", jax.devices()[0].device_kind)
    return f"{', '.join(versions)}; {', '.join(machine)}."


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str:
    """The processor's name."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "processor unknown"


def error_row(errors: np.ndarray) -> dict[str, float]:
    """The row of `ERROR_COLUMNS` for errors (N,)."""
    found = summarise(errors)
    return dict(zip(ERROR_COLUMNS, (found.median, found.auc, 100 * found.failure), strict=True))


def dataset_names(datasets: Sequence[Dataset]) -> list[str]:
    """What reports call datasets: their folders, so that nothing depends on where the data lie, if these differ."""
    names = [Path(parse_spec(dataset.spec)[2]).absolute().name for dataset in datasets]
    return names if len(set(names)) == len(names) else [dataset.spec for dataset in datasets]
