"""How long work takes: the median of several runs, after one that compiles."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np


def median_seconds(work: Callable[[], Any], repetitions: int) -> float:
    """The median time of some work, which has ended when it returns (see `computed`)."""
    work()
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def computed(function: Callable[..., Any], *inputs: Any) -> Callable[[], Any]:
    """The work of calling a function of JAX and waiting for its result."""
    import jax  # not above: a process that measures dlib does without it

    return lambda: jax.block_until_ready(function(*inputs))
