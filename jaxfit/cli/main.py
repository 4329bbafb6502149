"""The ``jaxfit`` command: parses arguments, says what is wrong in one line, keeps compiled code for later runs."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, NoReturn

import jaxfit
from jaxfit.cli import (
    collect,
    compare,
    completion,
    convert,
    demo,
    doctor,
    evaluate,
    experiments,
    export,
    finetune,
    fit,
    models,
    serve,
    suggest,
    track,
    train,
)
from jaxfit.cli.progress import say
from jaxfit.cli.streams import lasting_streams
from jaxfit.compile_cache import keep_compiled_code
from jaxfit.data.limits import DEFAULT_MEGAPIXELS, at_most_megapixels
from jaxfit.data.names import printable
from jaxfit.data.numbers import number, whole_number
from jaxfit.errors import JaxfitError

_STOPPED = 130  # by Ctrl-C
_COMMANDS = (
    fit,
    collect,
    track,
    serve,
    models,
    train,
    suggest,
    finetune,
    evaluate,
    compare,
    export,
    experiments,
    convert,
    demo,
    doctor,
    completion,
)
_EXIT_CODES = (
    "exit codes: 0 the command did what it was asked to; 1 no face could be fitted, or doctor found something that "
    "does not work; 2 a wrong request, or results that could not be written; 130 stopped by Ctrl-C"
)


class _Parser(argparse.ArgumentParser):
    """Reads numbers as the files' readers do: ``1_5`` is none."""

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self.register("type", float, number)
        self.register("type", int, whole_number)
        self._words: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As in `argparse`, which does not say what was given when it says what is missing, nor whose arguments are not
        recognised."""
        self._words = list(sys.argv[1:] if args is None else args)
        options, others = super().parse_known_args(self._words, namespace)
        if others and self._subparsers is None:
            self.error(f"unrecognized arguments: {' '.join(others)}")
        return options, others

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, and where it may come from: an option of several values takes all words that follow. Where
        a command is missing, list the commands."""
        missing = message.partition("the following arguments are required: ")[2].split(", ")
        lost = [name for name in missing if name and not name.startswith("-")]
        if not self._words and self._subparsers is not None:
            self.print_help(sys.stderr)
            self.exit(2)
        several = (action for action in self._actions if action.nargs in ("+", "*", "?"))
        given = [name for action in several for name in action.option_strings if name in self._words]
        taking = given if lost else [name for name in given if message.startswith(f"argument {name}: invalid")]
        if taking:
            own = " and ".join(lost) or "other words"
            message += f"; {taking[0]} takes all words that follow, up to the next option: put {own} before it"
        self.exit(2, f"{self.prog}: error: {printable(message)}\nsee {self.prog} --help\n")


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = _Parser(
        prog="jaxfit",
        description="Face landmarks, 3D shape and head pose by cascaded regression, in JAX.",
        epilog=_EXIT_CODES,
    )
    top.add_argument("--version", action="version", version=f"jaxfit {jaxfit.__version__}")
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    for module in _COMMANDS:
        module.add_command(commands)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 if it did what it was asked, 1 if no face could be fitted, 2 after a wrong request."""
    options = parser().parse_args(arguments)
    return exit_code(options.run, options)


def exit_code(run: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """What ``run`` returns; 2 after an error, which is said in one line, or where what it printed could not be written,
    and 130 if stopped. That nobody reads what it prints, as in ``jaxfit models | head -1``, is no error: results are
    written. Compiled code is kept."""
    with lasting_streams() as out:
        try:
            keep_compiled_code()
            with at_most_megapixels(getattr(options, "max_megapixels", DEFAULT_MEGAPIXELS)):
                code = run(options)
            out.flush()
        except (JaxfitError, OSError) as error:
            # Full disks, folders that may not be written to: nothing that a traceback would explain better.
            say(f"jaxfit: error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            say(
                "jaxfit: stopped; no result is half-written (fit and collect, run again, go on where they were)",
                file=sys.stderr,
            )
            return _STOPPED
        if out.problem is None:
            return code
        say(f"jaxfit: error: standard output: {out.problem.strerror}; results in files are whole", file=sys.stderr)
        return 2


def program() -> None:
    """The command as a program of its own, which ends at once when it is stopped: threads that decode large pictures do
    not hear of it."""
    with suppress(OSError, AttributeError):  # it may be closed
        if sys.stderr.fileno() == 2:  # what decoders print there is read by jaxfit
            sys.stderr = open(os.dup(2), "w", buffering=1, errors="backslashreplace")  # noqa: SIM115 - until the end
    code = main()
    if code == _STOPPED:
        os._exit(code)  # what was printed is flushed
    sys.exit(code)


if __name__ == "__main__":
    program()
