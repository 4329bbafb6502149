"""Arrays of numbers from MATLAB 5 files. SciPy's reader is not used: damaged files can crash the process in it.

A file is 128 bytes of header and then elements, each of a type, a size and a content. A variable is an element, often
a compressed one, whose content is elements again: flags, dimensions, name, numbers.
"""

import struct
import zlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from jaxfit.data.inputs import read_regular
from jaxfit.errors import DatasetError

# Types of elements.
_NUMBERS = {1: "<i1", 2: "<u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}
_MATRIX, _COMPRESSED = 14, 15
# Classes of matrices: the numeric ones, double to uint64. Others are text, containers, sparse matrices and objects.
_NUMERIC = range(6, 16)
_COMPLEX = 0x800
_HEADER = 128
_LARGEST = 1 << 26  # bytes of a file, and of its variables; a small one may claim to expand to any number


def read_matlab(path: Path) -> dict[str, np.ndarray]:
    """The variables of a MATLAB 5 file (MATLAB's versions 5 to 7) that are full arrays of real numbers, by name.

    Others are skipped. Arrays have the type that the numbers are stored in, which may be smaller than the variable's.

    Raises:
        DatasetError: the file cannot be read, is of another kind, or damaged.
    """
    try:
        data = read_regular(path, _LARGEST)
        # The version and the mark of files whose numbers start with the lowest byte.
        if data[124:_HEADER] != b"\x00\x01IM":
            raise ValueError("it does not start like one")
        return dict(_variables(data[_HEADER:]))
    except (OSError, ValueError, struct.error, zlib.error) as error:
        raise DatasetError(f"{path}: cannot be read as a file of MATLAB 5 to 7; {error}") from error


def _variables(data: bytes) -> Iterator[tuple[str, np.ndarray]]:
    left = _LARGEST
    for kind, content in _elements(data):
        if kind == _COMPRESSED:
            inflated = _inflated(content, left)
            left -= len(inflated)
            kind, content = _first(inflated, 1)[0]
        if kind == _MATRIX and _is_numeric(content):
            yield _array(content)


def _elements(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The type and the content of each element."""
    place = 0
    while place < len(data):
        kind, size = struct.unpack_from("<II", data, place)
        start, following = place + 8, place + 8 + size
        if kind >> 16:  # a small element: the type, the size and a content of up to four bytes share eight bytes
            kind, size, start, following = kind & 0xFFFF, min(kind >> 16, 4), place + 4, place + 8
        if start + size > len(data):
            raise ValueError("it is cut off or damaged")
        yield kind, data[start : start + size]
        place = following if kind == _COMPRESSED else following + (place - following) % 8


def _first(data: bytes, count: int) -> list[tuple[int, bytes]]:
    elements = list(islice(_elements(data), count))
    if len(elements) < count:
        raise ValueError("it is cut off or damaged")
    return elements


def _inflated(content: bytes, most: int) -> bytes:
    inflater = zlib.decompressobj()
    inflated = inflater.decompress(content, most + 1)  # 0 would mean without an end
    if not inflater.eof or len(inflated) > most:
        raise ValueError(f"a variable is cut off, or all are over {_LARGEST >> 20} MiB large")
    return inflated


def _is_numeric(matrix: bytes) -> bool:
    flags = struct.unpack_from("<I", _first(matrix, 1)[0][1])[0]
    return flags & 0xFF in _NUMERIC and not flags & _COMPLEX


def _array(matrix: bytes) -> tuple[str, np.ndarray]:
    _, (_, dimensions), (_, name), (kind, numbers) = _first(matrix, 4)
    if kind not in _NUMBERS:
        raise ValueError(f"numbers of an unknown type {kind}")
    shape = np.frombuffer(dimensions, "<i4").tolist()
    return name.decode("ascii"), np.frombuffer(numbers, _NUMBERS[kind]).reshape(shape, order="F")
