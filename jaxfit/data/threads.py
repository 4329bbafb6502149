"""Work done in threads, few pieces at a time, with results in the order of the work."""

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from itertools import chain, islice
from typing import TypeVar

_MOST_CORES = 8  # that are kept busy; each thread holds a picture
T = TypeVar("T")

_most_cores: ContextVar[int | None] = ContextVar("most_cores", default=None)


def in_order(work: Iterable[Callable[[], T]], threads: int) -> Generator[T, None, None]:
    """What pieces of work give, one after the other, while threads do the next ones.

    A single piece is done in the caller's thread, as it would take long to wake another; so are all without threads.
    Close the generator if no more is wanted: what has not begun is then not done.
    """
    pieces = iter(work)
    first = list(islice(pieces, 2))
    if threads == 0 or len(first) < 2:
        yield from (piece() for piece in chain(first, pieces))
        return
    pool = ThreadPoolExecutor(threads)
    waiting: deque[Future[T]] = deque()
    try:
        for piece in chain(first, pieces):
            waiting.append(pool.submit(copy_context().run, piece))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        # Ctrl-C does not wait for a large picture to be decoded.
        pool.shutdown(wait=not _interrupted(), cancel_futures=True)


def interruptible(work: Callable[[], T]) -> T:
    """What ``work`` gives, which is done in a thread where the caller is the main thread: code that is not Python's
    does not hear of Ctrl-C before it is done, and is left behind."""
    if threading.current_thread() is not threading.main_thread():
        return work()
    done: Future[T] = Future()

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=copy_context().run, args=(run,), daemon=True).start()
    return done.result()


def _interrupted() -> bool:
    """Whether the work ends because of Ctrl-C: it may be what closes the generator."""
    error = sys.exception()
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def reading_threads(count: int) -> int:
    """How many threads read and cut ``count`` pictures or faces: one more than keep the cores busy, as they wait
    for one another; none for a single one."""
    return min(_MOST_CORES, cores()) + 1 if count > 1 else 0


def cores() -> int:
    """How many this process may use, or fewer within `at_most_cores`."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(there, _most_cores.get() or there)


@contextmanager
def at_most_cores(count: int) -> Iterator[None]:
    """Fit with threads for this many cores only, because other processes use the others."""
    token = _most_cores.set(count)
    try:
        yield
    finally:
        _most_cores.reset(token)
