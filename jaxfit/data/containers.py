"""Whether a video's file is as long as it says itself: what containers promise of their frames is often an estimate."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
_ISO_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
_TAIL = 256  # bytes at the end that are zeros where a download was not finished


def is_cut(path: str | Path) -> bool:
    """Whether a Matroska, WebM, MP4, QuickTime or AVI file lacks its end; False for files that do not say."""
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _TAIL))
        if size > _TAIL and not file.read().strip(b"\0"):
            return True
        return any(end > size for end in _ends(file))


def _ends(file: IO[bytes]) -> Iterator[int]:
    """Where the outermost parts of a file end, as they say."""
    file.seek(0)
    head = file.read(12)
    if head.startswith(_EBML):
        yield from _end_of_segment(file)
    elif head.startswith(b"RIFF"):
        yield from _ends_of_chunks(file)
    elif head[4:8] in _ISO_BOXES:
        yield from _ends_of_boxes(file)


def _end_of_segment(file: IO[bytes]) -> Iterator[int]:
    file.seek(len(_EBML))
    length = _variable_length(file)
    if length is None:
        return
    file.seek(length, os.SEEK_CUR)
    if file.read(len(_SEGMENT)) == _SEGMENT and (length := _variable_length(file)) is not None:
        yield file.tell() + length


def _variable_length(file: IO[bytes]) -> int | None:
    """An element's length, as EBML writes it; None if it is not known, as in streams."""
    first = file.read(1)
    if not first or not first[0]:
        return None
    more = 8 - first[0].bit_length()
    length = int.from_bytes(bytes([first[0] & (0x7F >> more)]) + file.read(more))
    return None if length == (1 << 7 * (more + 1)) - 1 else length


def _ends_of_chunks(file: IO[bytes]) -> Iterator[int]:
    end = 0
    while True:
        file.seek(end)
        head = file.read(8)
        if head[:4] != b"RIFF" or len(head) < 8 or not (length := int.from_bytes(head[4:], "little")):
            return
        end += 8 + length
        yield end
        end += length % 2


def _ends_of_boxes(file: IO[bytes]) -> Iterator[int]:
    end = 0
    while True:
        file.seek(end)
        head = file.read(16)
        length = int.from_bytes(head[8:] if head[:4] == b"\0\0\0\1" else head[:4])
        if len(head) < 8 or length < 8:  # the last box may go on to the end
            return
        end += length
        yield end
