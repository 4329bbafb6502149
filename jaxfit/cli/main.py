"""The ``jaxfit`` command: parses arguments, says what is wrong in one line, keeps compiled code for later runs."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import jax

import jaxfit
from jaxfit.cli import evaluate, experiments, export, finetune, fit, models, serve, track, train
from jaxfit.exceptions import JaxfitError

_COMMANDS = (fit, track, serve, models, train, finetune, evaluate, export, experiments)


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = argparse.ArgumentParser(
        prog="jaxfit", description="Face landmarks, 3D shape and head pose by cascaded regression, in JAX."
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
    """What ``run`` returns; 2 after an error, which is said in one line, 130 if stopped. Compiled code is kept."""
    keep_compiled_code()
    try:
        return run(options)
    except (JaxfitError, OSError) as error:
        # Full disks, folders that may not be written to: nothing that a traceback would explain better.
        print(f"jaxfit: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxfit: stopped; nothing half-written was left behind", file=sys.stderr)
        return 130


def keep_compiled_code() -> None:
    """Let later runs start with what this one compiles, unless the user's own JAX settings say where."""
    if getattr(jax.config, "jax_compilation_cache_dir", None):
        return
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxfit"
        cache.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return  # no home, or a read-only one, costs some seconds at every start and nothing else
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


if __name__ == "__main__":
    sys.exit(main())
