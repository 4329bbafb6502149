"""``jaxfit completion``: a script with which a shell completes commands and options."""

import argparse

from jaxfit.cli.progress import say
from jaxfit.errors import InputError

_SHELLS = ("bash", "zsh")


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "completion",
        help="print a script with which a shell completes commands",
        description="Print a script with which a shell completes the commands and options of jaxfit. It needs "
        'shtab: pip install "jaxfit[completion]".',
    )
    command.add_argument("shell", choices=_SHELLS, help="the shell")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the script.

    Raises:
        InputError: shtab is not installed.
    """
    try:
        import shtab
    except ImportError:
        raise InputError('completion needs shtab, which is not installed: pip install "jaxfit[completion]"') from None
    from jaxfit.cli.main import parser  # which has this command, too

    say(shtab.complete(parser(), options.shell))
    return 0
