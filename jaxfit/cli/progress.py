"""Progress on the terminal: a bar where someone is looking, one line a stage in logs."""

import sys
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from tqdm import tqdm

from jaxfit.data.names import plain, printable


def say(text: str, **options: Any) -> None:
    """Print without what would move a terminal's cursor, as names of files may hold it; options are those of
    ``print``."""
    print(printable(text), **options)


class Bars:
    """A progress callback ``(stage, done, total)`` that shows one bar a stage on standard error."""

    def __init__(self) -> None:
        self._stage = ""
        self._bar: Any = None

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
            self._stage = stage
            if sys.stderr.isatty():
                self._bar = tqdm(total=total, desc=stage, dynamic_ncols=True, leave=False)
            else:
                say(f"{stage} …", file=sys.stderr, flush=True)
        if self._bar is not None:
            self._bar.total = total
            self._bar.update(done - self._bar.n)

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
