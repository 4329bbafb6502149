"""Importing JAX, which takes settings from the environment and refuses wrong ones with a traceback."""

import os
import sys
from pathlib import Path

from jaxfit.errors import InputError


def require_importable_jax() -> None:
    """Check that JAX can be imported with what the environment sets; the ``jaxfit`` command ends if it cannot.

    Raises:
        InputError: it cannot.
    """
    try:
        import jax  # noqa: F401 - as all modules do after this
    except ValueError as error:
        message = f"JAX cannot be imported: {error}{jax_settings()}"
        if _is_command():
            print(f"jaxfit: error: {message}", file=sys.stderr)
            sys.exit(2)
        raise InputError(message) from None


def jax_settings() -> str:
    """What the environment sets of JAX and what to do about it, as the end of a sentence; empty if it sets nothing."""
    found = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith("JAX_")]
    return f"; the environment sets {', '.join(found)}: correct what is wrong, or unset it" if found else ""


def _is_command() -> bool:
    """Whether this process runs the ``jaxfit`` command, in which no caller could catch an error."""
    words = sys.orig_argv[1:]
    while words and words[0].startswith("-") and words[0] != "-m":  # the interpreter's own options
        words = words[1:]
    return words[:2] == ["-m", "jaxfit"] or any(Path(name).name in ("jaxfit", "jaxfit.exe") for name in sys.argv[:1])
