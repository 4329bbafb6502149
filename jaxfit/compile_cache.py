"""Compiled code that later processes begin with."""

import os
from pathlib import Path

import jax


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
