"""Several processes that train or evaluate together: joining them, sharing out pictures, summing and exchanging.

JAX finds and connects them (``jax.distributed``). All they exchange are sums over a mesh of one device of each process:
what one alone has is summed with the zeros of the others. A process alone has nothing to exchange, and its values come
back as they are.
"""

import atexit
import hashlib
import json
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jax import numpy as jnp
from jax.errors import JaxRuntimeError
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxfit.errors import InputError, ProcessError
from jaxfit.modes import require_jax

T = TypeVar("T")


@contextmanager
def join_processes(
    coordinator: str | None = None, count: int | None = None, index: int | None = None
) -> Iterator[None]:
    """Train and evaluate together with other processes, which run the same program: within this context
    ``jaxfit.train`` and ``jaxfit.evaluate`` read only this process's share of the pictures, and give all the same.

    Enter it in the main thread and before anything is computed; JAX can join processes only once. It is left when all
    have come to its end, for which they wait five minutes. If an error leaves it, the process does not wait for the
    others when it ends, with exit status 2, and they end too.

    Args:
        coordinator: address and port, ``HOST:PORT``, at which the process 0 listens and all find each other; None, with
            the others: SLURM or Open MPI tells, which started the processes.
        count: how many processes there are.
        index: which of them this is, counted from 0.

    Raises:
        InputError: some of the arguments without the others, no such process, no SLURM or Open MPI where there are no
            arguments, or JAX has computed already.
        ProcessError: the others cannot be reached.
    """
    given = [value is not None for value in (coordinator, count, index)]
    if any(given) and not all(given):
        raise InputError(
            "expected a coordinator, the number of processes and which of them this is, or none of the three under "
            f"SLURM or Open MPI; got coordinator {coordinator}, processes {count}, process {index}"
        )
    if coordinator is not None and not re.fullmatch(r".+:\d+", coordinator):
        raise InputError(f"expected a coordinator as HOST:PORT; got {coordinator!r}")
    if count is not None and count < 1:
        raise InputError(f"expected at least one process; got {count}")
    if count is not None and index is not None and not 0 <= index < count:
        raise InputError(f"expected a process from 0 to {count - 1} of {count}; got {index}")
    _join(coordinator, count, index)
    try:
        yield
    except BaseException:
        # At its end JAX would wait for the others, which may wait for this one.
        atexit.register(_leave)
        raise
    jax.distributed.shutdown()


def _join(coordinator: str | None, count: int | None, index: int | None) -> None:
    """Have JAX connect the processes."""
    at_sigterm = signal.getsignal(signal.SIGTERM)
    try:
        jax.distributed.initialize(coordinator, count, index)
    except JaxRuntimeError as error:
        raise ProcessError(f"the processes cannot join: {error}") from error
    except (RuntimeError, ValueError) as error:
        why = "without a coordinator, processes are started by SLURM or Open MPI. " if coordinator is None else ""
        raise InputError(f"the processes cannot join: {why}{error}") from error
    # JAX only makes a note of it, for programs that ask, and would go on.
    signal.signal(signal.SIGTERM, at_sigterm)


def _leave() -> None:
    """End at once."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(2)


def is_first() -> bool:
    """Whether this is the process that writes and prints: the only one, or number 0."""
    return jax.process_index() == 0


def require_alone(work: str) -> None:
    """Check that there is one process only, for work that is not shared.

    Raises:
        InputError: there are several.
    """
    require_jax()
    if jax.process_count() > 1:
        raise InputError(f"{work} is not shared between processes; expected one, got {jax.process_count()}")


def require_same(*parts: Any) -> None:
    """Check that all processes work on the same: arrays, pytrees of them, and what ``repr`` tells.

    Raises:
        InputError: they do not.
    """
    if jax.process_count() == 1:
        return
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(parts):
        digest.update(np.asarray(leaf).tobytes() if isinstance(leaf, np.ndarray | jax.Array) else repr(leaf).encode())
    digests = exchanged(digest.hexdigest())
    if others := [number for number, each in enumerate(digests) if each != digests[0]]:
        raise InputError(
            f"expected the same model, faces, boxes and options in all processes; those of {others} are not those of 0"
        )


def share_of(pictures: Sequence[Path]) -> np.ndarray:
    """The numbers (M,) of the faces that this process reads, given the picture of each of N faces: no picture is read
    by two processes."""
    order = {picture: number for number, picture in enumerate(dict.fromkeys(pictures))}
    own = [number for number, each in enumerate(pictures) if order[each] % jax.process_count() == jax.process_index()]
    return np.array(own, int)


def total(values: T) -> T:
    """The sum over all processes of a pytree of arrays, which has the same shapes in each; at all of them."""
    return values if jax.process_count() == 1 else jax.tree.map(_sum, values)


def gathered(rows: np.ndarray, numbers: np.ndarray, count: int) -> np.ndarray:
    """All ``count`` rows at all processes, bit by bit; this one has those of ``numbers``, and each has one process."""
    if jax.process_count() == 1:
        return rows
    every = np.zeros((count, *rows.shape[1:]), rows.dtype)
    every[numbers] = rows
    return _of_one(every)


def exchanged(value: Any) -> list[Any]:
    """The JSON values of all processes, in their order, at all of them."""
    count, index = jax.process_count(), [jax.process_index()]
    if count == 1:
        return [value]
    text = np.frombuffer(json.dumps(value).encode(), np.uint8)
    sizes = gathered(np.array([len(text)]), np.array(index), count)
    texts = gathered(np.resize(text, (1, sizes.max())), np.array(index), count)
    return [json.loads(bytes(text[:size])) for text, size in zip(texts, sizes, strict=True)]


def by_first(compute: Callable[[], Any]) -> list[Any]:
    """The arrays of the pytree that the first process computes, None among them, at all processes: rounded alike
    wherever they run, and the others have less to do.

    Raises:
        InputError: ``compute`` raised it.
    """
    if jax.process_count() == 1:
        return _leaves(compute())
    leaves, problem = [], None
    if is_first():
        try:
            leaves = _leaves(compute())
        except InputError as error:
            problem = str(error)
    kinds = [None if leaf is None else (leaf.shape, str(leaf.dtype)) for leaf in leaves]
    kinds, problem = exchanged((kinds, problem))[0]
    if problem is not None:
        raise InputError(problem)
    if not is_first():
        leaves = [None if kind is None else np.zeros(*kind) for kind in kinds]
    return [None if leaf is None else jnp.asarray(_of_one(np.asarray(leaf))) for leaf in leaves]


def _leaves(tree: Any) -> list[Any]:
    return jax.tree.leaves(tree, is_leaf=lambda leaf: leaf is None)


def _of_one(values: np.ndarray) -> np.ndarray:
    """The sum of arrays of which each element is 0 in all processes but one, bit by bit, whatever the type."""
    return np.asarray(_sum(values.reshape(-1).view(np.uint8))).view(values.dtype).reshape(values.shape)


def _sum(values: Any) -> jax.Array:
    """The sum over processes of an array, on this process's first device."""
    shared = NamedSharding(_mesh(), PartitionSpec("processes"))
    try:
        of_all = jax.make_array_from_process_local_data(shared, np.asarray(values)[None])
        return jax.block_until_ready(_summed(of_all, _mesh()).addressable_data(0))
    except (JaxRuntimeError, ValueError) as error:  # which of them depends on who waits for the result
        raise ProcessError(
            "another process ended before the work was done; its own message says why. Start all of them again "
            f"({str(error).splitlines()[0]})"
        ) from error


@partial(jax.jit, static_argnums=1)
def _summed(values: jax.Array, mesh: Mesh) -> jax.Array:
    """(N, ...), a row a process, to their sum, which each has."""
    return jax.lax.with_sharding_constraint(values.sum(0, dtype=values.dtype), NamedSharding(mesh, PartitionSpec()))


@cache
def _mesh() -> Mesh:
    """A device of each process."""
    first = {device.process_index: device for device in reversed(jax.devices())}
    return Mesh(np.array([first[number] for number in sorted(first)]), ("processes",))
