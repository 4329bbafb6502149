"""Commands that several processes run together: the options that join them, and a single one that speaks."""

import argparse
import os
from collections.abc import Callable
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from functools import partial

from jaxfit.errors import InputError
from jaxfit.processes import is_first, join_processes

_Run = Callable[[argparse.Namespace], int]


def add_processes(command: argparse.ArgumentParser, run: _Run) -> None:
    """``--coordinator HOST:PORT``, ``--processes N``, ``--process I`` and ``--distributed``, and a ``run`` that heeds
    them."""
    group = command.add_argument_group(
        "several processes", "start each with the same command; see docs/guides/clusters-and-collections.md"
    )
    group.add_argument("--coordinator", metavar="HOST:PORT", help="where process 0 runs, and a free port there")
    group.add_argument("--processes", type=int, metavar="N", help="number of processes")
    group.add_argument("--process", type=int, metavar="I", help="number of this process, counted from 0")
    group.add_argument(
        "--distributed",
        action="store_true",
        help="take all three from SLURM or Open MPI, which started the processes",
    )
    command.set_defaults(run=partial(_run_together, run))


def _run_together(run: _Run, options: argparse.Namespace) -> int:
    """Run the command, together with other processes if there are any: the first writes and prints, the others say only
    why they ended."""
    where = options.coordinator, options.processes, options.process
    if options.distributed and any(value is not None for value in where):
        raise InputError("expected --distributed, or --coordinator, --processes and --process; got both")
    if not options.distributed and all(value is None for value in where):
        return run(options)
    with join_processes(*where), ExitStack() as stack:
        if not is_first():
            nowhere = stack.enter_context(open(os.devnull, "w"))
            stack.enter_context(redirect_stdout(nowhere))
            stack.enter_context(redirect_stderr(nowhere))
        return run(options)
