"""Progress on the terminal: a bar where someone is looking, lines now and then in logs."""

import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from tqdm import tqdm

from jaxfit.data.names import plain, printable

_PAUSE = 10.0  # seconds between the lines of a log; in long stages more,
_SHARE = 0.05  # this share of the time so far, so that a night does not fill a log


def say(text: str, **options: Any) -> None:
    """Print without what would move a terminal's cursor, as names of files may hold it; options are those of
    ``print``."""
    print(printable(text), **options)


class Bars:
    """A progress callback ``(stage, done, total)`` that shows one bar a stage on standard error; in logs a line where a
    stage begins, unless that is not ``announced``, and then lines that say how far it is."""

    def __init__(self, announced: bool = True) -> None:
        self._announced = announced
        self._stage = ""
        self._bar: Any = None
        self._done_before, self._begun, self._next_line = 0, 0.0, time.monotonic() + _PAUSE

    def __enter__(self) -> "Bars":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` are done."""
        if stage != self._stage:
            self._close()
            self._stage, self._done_before, self._begun = stage, done, time.monotonic()
            if sys.stderr.isatty():
                self._bar = tqdm(total=total, desc=stage, dynamic_ncols=True, leave=False)
            elif self._announced:
                self._line(f"{stage} …")
        if self._bar is not None:
            self._bar.total = total
            self._bar.update(done - self._bar.n)
        elif time.monotonic() >= self._next_line:
            rate = (done - self._done_before) / (time.monotonic() - self._begun or 1.0)
            self._line(f"{stage}: {done:,} of {total:,}, {rate:,.1f}/s")

    def _line(self, text: str) -> None:
        """Print a line of a log."""
        say(text, file=sys.stderr, flush=True)
        now = time.monotonic()
        self._next_line = now + max(_PAUSE, _SHARE * (now - self._begun))

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def warn(sentences: Sequence[str]) -> None:
    """Say before the work, on standard error, what of the request may not do what is meant."""
    for sentence in sentences:
        say(f"warning: {plain(sentence)}", file=sys.stderr, flush=True)


def report_problems(problems: list[str], shown: int = 20) -> None:
    """List what went wrong, at the end, on standard error."""
    if not problems:
        return
    say(f"{len(problems)} problem{'s' if len(problems) > 1 else ''}:", file=sys.stderr)
    for problem in problems[:shown]:
        say(f"  {plain(problem)}", file=sys.stderr)  # in one line
    if len(problems) > shown:
        say(f"  … and {len(problems) - shown} more", file=sys.stderr)
