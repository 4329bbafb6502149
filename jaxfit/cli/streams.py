"""Standard output and error that may be closed, or that no one reads: neither stops the work."""

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any


class _Lasting:
    """A text stream that goes on when its reader has gone, or its disk is full, and keeps why for the end.

    Attributes:
        problem: what was not written and why, unless the reader had enough; None if all was.
    """

    problem: OSError | None = None

    def __init__(self, stream: Any):
        self._stream = stream
        self._lost = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, if there is anybody to read it."""
        if not self._lost:
            self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Hand over what was written."""
        if not self._lost:
            self._try(self._stream.flush)

    def _try(self, work: Callable[[], object]) -> None:
        try:
            work()
        except BrokenPipeError:
            self._lose()
        except OSError as error:
            self.problem = error
            self._lose()

    def _lose(self) -> None:
        self._lost = True
        with suppress(OSError, ValueError):  # Python flushes the stream at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


@contextmanager
def lasting_streams() -> Iterator[_Lasting]:
    """Within it printing never stops the work; gives standard output, which says in the end if something is missing."""
    # Files that are opened would get the numbers of closed streams, and libraries would print into results.
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    before = sys.stdout, sys.stderr
    out, errors = (_Lasting(_open(stream)) for stream in before)
    sys.stdout, sys.stderr = out, errors
    try:
        yield out
    finally:
        out.flush()
        errors.flush()
        sys.stdout, sys.stderr = before


def _open(stream: Any) -> Any:
    """The stream; where Python found it closed, one that nobody reads."""
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="backslashreplace")  # names of files need not be text
    return stream
