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
        message = f"JAX cannot be imported: {error}; {jax_settings()}: correct them, or unset them"
        if _is_command():
            print(f"jaxfit: error: {message}", file=sys.stderr)
            sys.exit(2)
        raise InputError(message) from None


def jax_settings() -> str:
    """What the environment sets of JAX, in words."""
    found = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith("JAX_")]
    return f"the environment sets {', '.join(found)}" if found else "the environment sets nothing of JAX"


def _is_command() -> bool:
    """Whether this process runs the ``jaxfit`` command: nobody could catch what is raised."""
    words = sys.orig_argv[1:]
    module = words[words.index("-m") + 1 :][:1] if "-m" in words else []
    return module == ["jaxfit"] or Path(sys.argv[0]).stem == "jaxfit"
