"""How large pictures may be: what a header promises is looked at before anything is decoded.

A file of some kilobytes can stand for gigabytes of pixels, or for minutes of work. Whatever reads pictures asks here.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Condition

from jaxfit.errors import InputError

DEFAULT_MEGAPIXELS = 180.0
_MOST_SCANS = 100  # of a progressive JPEG, which have about ten; each goes through the whole picture
_MOST_WORK = 2000.0  # million pixels times scans
_MOST_MEGAPIXELS = 1000.0  # OpenCV's own limit is 2^30 pixels
MOST_SLOW_BYTES = 64_000_000  # of AVIF, HEIC and JPEG 2000, each of which takes a sixth of a microsecond
_BYTES_OF_PIXEL, _BYTES_OF_HEADERS = 8, 1 << 26  # the most that formats without compression take

_megapixels: ContextVar[float] = ContextVar("megapixels", default=DEFAULT_MEGAPIXELS)


@contextmanager
def at_most_megapixels(megapixels: float) -> Iterator[None]:
    """Read pictures of up to ``megapixels`` million pixels in this block, instead of 180; larger ones are problems.

    Pictures that are fitted at the same time have at most as many together. Memory and time grow with it;
    ``scripts/bombs.py`` measures how. Pixels of AVIF, HEIC, floats, and JPEG 2000 with transparency count more.

    Raises:
        InputError: it is not positive, or over 1000.
    """
    if not 0 < megapixels <= _MOST_MEGAPIXELS:
        raise InputError(f"expected at most 1 to {_MOST_MEGAPIXELS:g} megapixels a picture; got {megapixels:g}")
    token = _megapixels.set(megapixels)
    try:
        yield
    finally:
        _megapixels.reset(token)


def most_megapixels() -> float:
    """How many million pixels a picture may have."""
    return _megapixels.get()


class _Block:
    """The pictures that a block of `counted_together`, or all of them, have read."""

    def __init__(self) -> None:
        self.pixels = 0


_block: ContextVar[_Block | None] = ContextVar("block", default=None)
_turn, _all = Condition(), _Block()


@contextmanager
def counted_together() -> Iterator[None]:
    """Pictures that are read in such blocks, in however many threads, have at most as many pixels together as one may
    have: each waits until those of others are few enough, and counts until its block ends."""
    block = _Block()
    token = _block.set(block)
    try:
        yield
    finally:
        _block.reset(token)
        if block.pixels:
            with _turn:
                _all.pixels -= block.pixels
                _turn.notify_all()


def count_picture(pixels: int) -> None:
    """Wait, in a block of `counted_together`, until there is room for a picture of this many pixels."""
    block = _block.get()
    if block is None:
        return
    with _turn:
        if not block.pixels:  # blocks that have read some would wait for one another
            _turn.wait_for(lambda: not _all.pixels or _all.pixels + pixels <= most_megapixels() * 1e6)
        block.pixels += pixels
        _all.pixels += pixels


def most_picture_bytes() -> int:
    """How large the file of a picture may be."""
    return _BYTES_OF_HEADERS + int(most_megapixels() * 1e6) * _BYTES_OF_PIXEL


def size_problem(width: int, height: int, scans: int = 1, weight: float = 1.0, slow_bytes: int = 0) -> str | None:
    """Why not to decode a picture of such a size, as a sentence; None if there is no reason.

    Args:
        width: in pixels, as its header says.
        height: likewise.
        scans: as in `jaxfit.data.sizes.Cost`.
        weight: likewise.
        slow_bytes: likewise.
    """
    millions, most = width * height / 1e6 * weight, most_megapixels()
    if millions > most:
        verb = "are" if weight == 1 else "of this format count as"
        return (
            f"{width} x {height} pixels {verb} {millions:,.0f} megapixels; expected at most {most:g}: shrink it, or "
            "allow more (--max-megapixels, jaxfit.data.at_most_megapixels)"
        )
    if scans > _MOST_SCANS or scans * millions > _MOST_WORK:
        return f"a progressive JPEG of {scans} scans of {width} x {height} pixels takes too long; save it again"
    if slow_bytes > MOST_SLOW_BYTES:
        return f"a file of {slow_bytes:,} bytes in this format takes too long; save it as JPEG or PNG"
    return None
