"""``jaxfit experiments``: run the experiments of a configuration, and report on them."""

import argparse
import sys
import time
from collections import Counter
from math import isnan
from pathlib import Path

from jaxfit.cli.arguments import out_folder
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.evaluation.tables import text_table
from jaxfit.experiments.cells import Cell, plan
from jaxfit.experiments.config import read_config
from jaxfit.experiments.lab import Lab
from jaxfit.experiments.page import write_document
from jaxfit.experiments.report import document
from jaxfit.experiments.results import read_results
from jaxfit.experiments.running import SETTINGS, Standing, keep_settings, probe_pace, run, standing


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "experiments",
        help="compare methods on datasets as the thesis does, and report",
        description="Cross-validate methods over grids of augmentations, steps and initialisations, time them and test "
        "their pose, as a configuration in TOML says; then report, with the thesis's numbers beside what was measured.",
    )
    actions = command.add_subparsers(required=True, metavar="ACTION")
    running = actions.add_parser(
        "run",
        help="do what a configuration says that is not done yet",
        description="Do what a configuration says that is not done yet. A killed run goes on where it was; several "
        "processes may run at once with the same --out and share the work.",
    )
    running.add_argument("config", metavar="CONFIG.toml", help="what to run; paths in it are relative to this folder")
    running.add_argument("--out", required=True, metavar="DIR", help="where results are kept")
    running.add_argument("--dry-run", action="store_true", help="only say what there is to do, and how long it takes")
    running.set_defaults(run=run_command)
    reporting = actions.add_parser(
        "report",
        help="tables, figures and a page from results",
        description="Write report.html, tables as CSV and LaTeX and figures as SVG and PNG from what has been run.",
    )
    reporting.add_argument("folder", metavar="DIR", help="the --out of jaxfit experiments run")
    reporting.add_argument("--out", metavar="DIR", help="where the report goes; unless given to DIR/report")
    reporting.add_argument(
        "--no-pictures",
        action="store_true",
        help="draw landmarks without the pictures, for reports of pictures that may not be passed on",
    )
    reporting.set_defaults(run=report_command)


def run_command(options: argparse.Namespace) -> int:
    """Run the cells, or say what there is to run."""
    config = read_config(options.config)
    if options.dry_run:
        return _dry_run(Lab(config, Path(options.out)))
    folder = out_folder(options.out)
    begin = time.monotonic()
    with Bars() as bars:
        told = _CellProgress(bars)
        run(config, folder, told.within, told.begun)
    results = read_results(folder)
    report_problems(list(results.problems))
    done = f"{results.cells - results.missing} of {results.cells} cells done"
    took = f"{told.ran} of them now, in {duration(time.monotonic() - begin)}"
    print(f"{done}, {took}; next: jaxfit experiments report {options.out}")
    return 0


class _CellProgress:
    """Where someone is looking, bars that name the cell and say how long the rest takes; in logs a line a cell."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self.ran = 0
        self._cell = ""

    def begun(self, cell: Cell, state: Standing) -> None:
        """A cell begins."""
        self.ran += 1
        left = "" if isnan(state.seconds_left) else f", {duration(state.seconds_left)} left"
        self._cell = f"{state.done + 1}/{state.cells}{left}: {cell.name}"
        if not sys.stderr.isatty():
            print(self._cell, file=sys.stderr, flush=True)

    def within(self, stage: str, done: int, total: int) -> None:
        """So much of a stage of the cell is done."""
        if sys.stderr.isatty():
            self._bars(f"{self._cell}, {stage}", done, total)


def _dry_run(lab: Lab) -> int:
    if (lab.folder / SETTINGS).exists():
        keep_settings(lab)
    state = standing(lab)
    seconds = state.seconds_left if state.done else state.work_left * probe_pace()
    cells = plan(lab.config)
    kinds = Counter("/".join(cell.name.split("/")[:2]) for cell in cells)
    done = Counter("/".join(cell.name.split("/")[:2]) for cell in cells if lab.result(cell.name).exists())
    rows = [{"cells": kind, "in all": count, "done": done[kind]} for kind, count in kinds.items()]
    for name, faces in lab.faces.items():
        print(f"{name}: {len(faces.records)} faces with all {faces.scheme.count} landmarks ({faces.scheme.name})")
    report_problems([problem for faces in lab.faces.values() for problem in faces.problems])
    print(text_table(rows, {"cells": "", "in all": "d", "done": "d"}))
    measured = "by a short measurement on this machine; what was never compiled here takes minutes more"
    how = "by the pace so far" if state.done else measured
    print(
        f"{state.cells - state.done} of {state.cells} cells to run; one process takes about {duration(seconds)}, {how}"
    )
    return 0


def report_command(options: argparse.Namespace) -> int:
    """Write the report."""
    folder = Path(options.folder)
    results = read_results(folder)
    target = out_folder(options.out or str(folder / "report"))
    write_document(document(results, pictures=not options.no_pictures), target)
    if results.missing:
        missing = f"{results.missing} of {results.cells} cells are not run yet"
        print(f"{missing}; what needs them is left out", file=sys.stderr)
    print(f"written: {target / 'report.html'}, tables, figures")
    return 0


def duration(seconds: float) -> str:
    """Seconds as people say it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
