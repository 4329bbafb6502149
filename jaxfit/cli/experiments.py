"""``jaxfit experiments``: run the experiments of a configuration, and report on them."""

import argparse
import sys
import time
from collections import Counter
from math import isnan
from pathlib import Path

from jaxfit.cli.arguments import out_folder
from jaxfit.cli.progress import Bars, report_problems, say
from jaxfit.data.outputs import replace_results, require_own_folder
from jaxfit.evaluation.tables import text_table
from jaxfit.experiments.config import read_config
from jaxfit.experiments.experiment import SETTINGS, Experiment
from jaxfit.experiments.page import write_files
from jaxfit.experiments.report import build_report
from jaxfit.experiments.results import read_results
from jaxfit.experiments.runner import Status, experiment_status, run_experiment, seconds_per_window, seconds_to_compile
from jaxfit.experiments.tasks import Task, plan_tasks

_RUN, _REPORT = "jaxfit experiments run", "jaxfit experiments report"
_KEPT = ("datasets", "models", "results")  # folders of what tasks have made


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "experiments",
        help="compare methods on datasets by cross-validation, and report",
        description="Cross-validate methods over grids of augmentations, steps and initialisations, time them "
        "and test their pose, as a TOML file says; then report the results.",
    )
    actions = command.add_subparsers(required=True, metavar="ACTION")
    running = actions.add_parser(
        "run",
        help="run the tasks of a configuration that are not done yet",
        description="Run the tasks of a configuration that are not done yet. A run that was killed goes on "
        "where it was; several processes may run at once with the same --out and share the work.",
    )
    running.add_argument("config", metavar="CONFIG.toml", help="what to run; paths in it are relative to this folder")
    running.add_argument("--out", required=True, metavar="DIR", help="where results are kept")
    running.add_argument(
        "--dry-run", action="store_true", help="only say what there is to do, and how long it will take"
    )
    running.set_defaults(run=run_command)
    reporting = actions.add_parser(
        "report",
        help="tables, figures and a page from results",
        description="Write report.html, tables as CSV and LaTeX and figures as SVG and PNG from what has been run.",
    )
    reporting.add_argument("folder", metavar="DIR", help="the folder that was the --out of jaxfit experiments run")
    reporting.add_argument("--out", metavar="DIR", help="where the report goes (default: DIR/report)")
    reporting.add_argument(
        "--no-pictures",
        action="store_true",
        help="draw landmarks without the pictures, for reports whose pictures may not be passed on",
    )
    reporting.set_defaults(run=report_command)


def run_command(options: argparse.Namespace) -> int:
    """Run the tasks, or say what there is to run."""
    config = read_config(options.config)
    if options.dry_run:
        return _dry_run(Experiment(config, Path(options.out)))
    require_own_folder(options.out, _RUN)
    folder = out_folder(options.out)
    begin = time.monotonic()
    with Bars(announced=False) as bars:
        progress = _TaskProgress(bars)
        run_experiment(config, folder, progress=progress.within, begun=progress.begun)
    results = read_results(folder)
    kept = (path for part in _KEPT for path in (folder / part).rglob("*") if path.is_file())
    written = [SETTINGS, *(path.relative_to(folder).as_posix() for path in kept)]
    replace_results(folder, _RUN, written, {"config": Path(options.config).name})
    report_problems(list(results.problems))
    done = f"{results.tasks - results.missing} of {results.tasks} tasks done"
    took = f"{progress.ran} of them now, in {duration(time.monotonic() - begin)}"
    say(f"{done}, {took}; next: jaxfit experiments report {options.out}")
    return 0


class _TaskProgress:
    """On a terminal, bars that name the task and say how long the rest takes; in logs a line a task, and
    lines now and then in long ones."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self.ran = 0
        self._task = ""

    def begun(self, task: Task, status: Status) -> None:
        """A task begins."""
        self.ran += 1
        left = "" if isnan(status.seconds_left) else f", {duration(status.seconds_left)} left"
        self._task = f"{status.done + 1}/{status.tasks}{left}: {task.name}"
        if not sys.stderr.isatty():
            say(self._task, file=sys.stderr, flush=True)

    def within(self, stage: str, done: int, total: int) -> None:
        """So much of a stage of the task is done."""
        self._bars(f"{self._task}, {stage}", done, total)


def _dry_run(experiment: Experiment) -> int:
    if (experiment.folder / SETTINGS).exists():
        experiment.keep_settings()
    status = experiment_status(experiment)
    if status.done:
        seconds, how = status.seconds_left, "by the pace so far"
    else:
        seconds = status.work_left * seconds_per_window() + seconds_to_compile(experiment)
        how = "by a short measurement on this machine, with the compilation of each training"
    tasks = plan_tasks(experiment.config)
    kinds = Counter("/".join(task.name.split("/")[:2]) for task in tasks)
    done = Counter("/".join(task.name.split("/")[:2]) for task in tasks if experiment.done(task.name))
    rows = [{"tasks": kind, "in all": count, "done": done[kind]} for kind, count in kinds.items()]
    for name, faces in experiment.faces.items():
        say(f"{name}: {len(faces.records)} faces with all {faces.scheme.count} landmarks ({faces.scheme.name})")
    report_problems([problem for faces in experiment.faces.values() for problem in faces.problems])
    say(text_table(rows, {"tasks": "", "in all": "d", "done": "d"}))
    left = f"{status.tasks - status.done} of {status.tasks} tasks to run"
    say(f"{left}; one process takes about {duration(seconds)}, {how}")
    return 0


def report_command(options: argparse.Namespace) -> int:
    """Write the report."""
    folder = Path(options.folder)
    results = read_results(folder)
    out = options.out or str(folder / "report")
    require_own_folder(out, _REPORT)
    target = out_folder(out)
    written = write_files(build_report(results, pictures=not options.no_pictures), target)
    replace_results(target, _REPORT, written, {"pictures": not options.no_pictures})
    if results.missing:
        missing = f"{results.missing} of {results.tasks} tasks are not run yet"
        say(f"{missing}; the parts of the report that need them are left out", file=sys.stderr)
    say(f"written: {target / 'report.html'}, tables, figures")
    return 0


def duration(seconds: float) -> str:
    """Seconds in a unit that suits them."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
