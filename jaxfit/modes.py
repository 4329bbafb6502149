"""Under which of JAX's modes the package computes, whatever the caller has set, and in which processes it can.

Some modes mean the caller's own code and would stop ours: a guard against transfers, as pictures have to come to the
device, a search for NaNs, which stand here for what is not known, and a ban on arrays of other ranks. Others are
followed: arrays of float32 stay so under ``jax_enable_x64``, and no types are mixed that
``jax_numpy_dtype_promotion="strict"`` refuses.
"""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

from jaxfit.environment import jax_settings
from jaxfit.errors import InputError, ProcessError

P = ParamSpec("P")
R = TypeVar("R")
# The process that has computed first: this one or one that this one was forked from.
_first: int | None = None


def _note_before_fork() -> None:
    """Remember that JAX has computed in this process, if only for others, before it is forked."""
    global _first
    # JAX has no public way to ask; without this one, only what jaxfit itself has computed is known.
    if _first is None and getattr(sys.modules.get("jax._src.xla_bridge"), "_backends", None):
        _first = os.getpid()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_note_before_fork)


def require_jax() -> None:
    """Check that JAX can compute in this process: that it has a device, and was not forked from one that has computed,
    whose threads are missing in it and would be waited for in vain.

    Raises:
        InputError: there is no such device as JAX is set to compute on.
        ProcessError: it was forked.
    """
    global _first
    if _first is None:
        _require_device()
        _first = os.getpid()
    elif _first != os.getpid():
        raise ProcessError(
            "this process was forked from one that has computed with JAX, and JAX would hang in it; start processes "
            'by spawn: multiprocessing.get_context("spawn"), or DataLoader(..., multiprocessing_context="spawn"), or '
            "load models and fit in the new processes only"
        )


def _require_device() -> None:
    platforms = getattr(jax.config, "jax_platforms", None)
    try:
        jax.local_devices()
    except Exception as error:  # which one depends on the platform
        reason = str(error).partition("(set JAX_PLATFORMS")[0].strip() or type(error).__name__
        if not platforms:
            raise InputError(
                f"JAX cannot compute here: {reason}; {jax_settings()}: correct them, or unset them"
            ) from None
        raise InputError(
            f"JAX cannot compute on {platforms!r}, which JAX_PLATFORMS or jax_platforms asks for: {reason}; expected "
            'a platform that JAX is installed for, such as "cpu", or none, so that JAX chooses'
        ) from None


@contextmanager
def own_modes() -> Iterator[None]:
    """Within it the package computes, in this thread.

    Raises:
        InputError: as `require_jax`, which also raises ProcessError.
    """
    require_jax()
    with jax.transfer_guard("allow"), jax.debug_nans(False), jax.numpy_rank_promotion("allow"):
        yield


def computing(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which computes within `own_modes`: what people call from Python."""

    @wraps(function)
    def within(*arguments: P.args, **options: P.kwargs) -> R:
        with own_modes():
            return function(*arguments, **options)

    return within


@contextmanager
def mixing_types() -> Iterator[None]:
    """Within it other libraries' code, such as optax's, may mix types as JAX lets it by default."""
    with jax.numpy_dtype_promotion("standard"):
        yield
