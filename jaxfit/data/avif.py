"""AVIF files: their boxes, and how large their pictures are as the pixels' own headers say, which decoders go by."""

import re
import struct
from collections.abc import Iterator
from itertools import chain

_SEQUENCE_HEADER = 1  # the kind of a unit of AV1
_MOST_UNITS = 4096  # of AV1 in one picture
_MOST_ITEMS, _MOST_EXTENTS, _MOST_BYTES = 4096, 64, 1 << 16  # of the list of places, where some take no room at all


class _Numbers:
    """Whole numbers from bytes, read one after another, each of a given number of bits."""

    def __init__(self, data: bytes):
        self._bits, self._left = int.from_bytes(data), 8 * len(data)

    def take(self, bits: int) -> int:
        """The next one.

        Raises:
            ValueError: too few bits are left.
        """
        self._left -= bits
        if self._left < 0:
            raise ValueError("cut off")
        return self._bits >> self._left & (1 << bits) - 1


def coded_sizes(data: bytes) -> Iterator[tuple[int, int]]:
    """Width and height of all pictures of a file, and of its films' first ones, as AV1's sequence headers say.

    Raises:
        ValueError: the file is cut off, or holds more parts than pictures have.
    """
    for picture in chain(_items(data), _films(data)):
        yield from map(_size, _sequence_headers(picture))


def _items(data: bytes) -> Iterator[bytes]:
    """What is in the items, which the box ``iloc`` has the places of."""
    boxes = boxes_in(boxes_in(data).get(b"meta", b"")[4:])
    places = boxes.get(b"iloc")
    if places is None:
        return
    numbers = _Numbers(places[:_MOST_BYTES])
    version = numbers.take(8)
    numbers.take(24)
    offset_bits, length_bits, base_bits, index_bits = (8 * numbers.take(4) for _ in range(4))
    count = numbers.take(16 if version < 2 else 32)
    if count > _MOST_ITEMS:
        raise ValueError("too many items")
    left = 2 * len(data)  # items may share bytes, but pictures do not
    for _ in range(count):
        numbers.take(16 if version < 2 else 32)
        within = boxes.get(b"idat", b"") if version and numbers.take(16) & 15 == 1 else data
        numbers.take(16)
        base, extents, parts = numbers.take(base_bits), numbers.take(16), []
        if extents > _MOST_EXTENTS:
            raise ValueError("too many extents")
        for _ in range(extents):
            numbers.take(index_bits if version else 0)
            place = base + numbers.take(offset_bits)
            length = numbers.take(length_bits) or len(data)  # without one, all that follows
            parts.append(within[place : place + length])
            left -= len(parts[-1])
            if left < 0:
                raise ValueError("items of more bytes than the file has")
        yield b"".join(parts)


def _films(data: bytes) -> Iterator[bytes]:
    """What films begin with, which the boxes ``stco`` and ``co64`` have the places of."""
    film = boxes_in(data).get(b"moov", b"")
    for found in re.finditer(b"(stco)|co64", film):
        (place,) = struct.unpack_from(">I" if found[1] else ">Q", film, found.end() + 8)
        yield data[place : place + _MOST_BYTES]


def _sequence_headers(units: bytes) -> Iterator[_Numbers]:
    """What is in the sequence headers among units of AV1."""
    at = 0
    for _ in range(_MOST_UNITS):
        if at >= len(units):
            return
        first = units[at]
        if first & 128:  # no unit
            return
        at += 2 if first & 4 else 1
        size = len(units)
        if first & 2:  # it says how long it is, in groups of seven bits
            size = 0
            for group in range(8):
                byte = units[at] if at < len(units) else 0
                size |= (byte & 127) << 7 * group
                at += 1
                if byte < 128:
                    break
        if first >> 3 & 15 == _SEQUENCE_HEADER:
            yield _Numbers(units[at : at + min(size, _MOST_BYTES)])
        at += size
    raise ValueError("too many units")


def _size(numbers: _Numbers) -> tuple[int, int]:
    """The size in a sequence header, as section 5.5 of the AV1 specification has it."""
    take = numbers.take
    take(4)
    if not take(1):  # not the short form of still pictures
        delay_bits = 0
        if take(1):  # how long frames are shown
            take(64)
            if take(1):
                zeros = 0
                while not take(1):
                    zeros += 1
                take(zeros)
            if take(1):
                delay_bits = take(5) + 1
                take(32 + 5 + 5)
        delayed = take(1)
        for _ in range(take(5) + 1):
            take(12)
            if take(5) > 7:
                take(1)
            if delay_bits and take(1):
                take(2 * delay_bits + 1)
            if delayed and take(1):
                take(4)
    else:
        take(5)
    width_bits, height_bits = take(4) + 1, take(4) + 1
    return take(width_bits) + 1, take(height_bits) + 1


def boxes_in(data: bytes) -> dict[bytes, bytes]:
    """What is in the boxes of an ISO file, or of a box, by their kinds; of several, the first."""
    found: dict[bytes, bytes] = {}
    for kind, body in each_box(data):
        found.setdefault(kind, body)
    return found


def each_box(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """The boxes of an ISO file, or of a box: their kinds, and what is in them."""
    at = 0
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        head = 8
        if length == 1:
            (length,) = struct.unpack_from(">Q", data, at + 8)
            head = 16
        length = length or len(data) - at  # the last may go on to the end
        if length < head:
            return
        yield kind, data[at + head : at + length]
        at += length
