"""How large pictures of all formats that are read become when they are decoded, as their first bytes say."""

import re
import struct
from typing import NamedTuple

from jaxfit.data.avif import coded_sizes
from jaxfit.data.headers import (
    ISO_PICTURES,
    JPEG,
    PNG,
    START_OF_SCAN,
    JpegHead,
    jpeg_head,
    jpeg_markers,
    largest_item,
    stored_size,
)

TIFF = {b"II*\0": "<", b"MM\0*": ">", b"II+\0": "<", b"MM\0+": ">"}  # the order of bytes; with a plus, large files
_WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 277, 322, 323
_NUMBERS = {1: "B", 3: "H", 4: "I", 16: "Q"}  # TIFF's types of whole numbers
_NETPBM = re.compile(rb"P[1-6Ff](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")
_NETPBM_DEPTH = re.compile(rb"P[2356](?:(?:\s|#[^\n]*\n)+\d{1,9}){2}(?:\s|#[^\n]*\n)+(\d{1,9})\s")
_PAM = re.compile(rb"P7\s.*?WIDTH\s+(\d{1,9}).*?HEIGHT\s+(\d{1,9})", re.DOTALL)
_RADIANCE = re.compile(rb"#\?.*?\n\n[+-]Y (\d{1,9}) [+-]X (\d{1,9})\n", re.DOTALL)
_SUN = b"\x59\xa6\x6a\x95"
_MOST_BOXES = 4096  # before the pixels of a JPEG 2000 file
_CODESTREAM = b"\xff\x4f\xff\x51"  # JPEG 2000
_FLOATS = (b"PF", b"Pf")  # Netpbm's
HEAVY = 2.5  # of formats whose pixels may take 36 bytes while they are decoded
_HEAD = 8192  # bytes that headers of text may take; looking through them takes the square


class Cost(NamedTuple):
    """What decoding a picture takes, as its header says.

    Attributes:
        size: width and height in pixels of what a decoder makes of it, or of a larger tile of a TIFF file; None of what
            no decoder here reads.
        scans: how often a decoder goes through it: the scans of a JPEG file, 1 of all else.
        weight: as how many pixels one of it counts, for the memory that its format takes: 1, or more.
        slow_bytes: how many of its bytes are coded so densely that each takes long; 0 of most formats.
    """

    size: tuple[int, int] | None
    scans: int = 1
    weight: float = 1.0
    slow_bytes: int = 0


def cost_of(data: bytes, head: JpegHead | None = None) -> Cost:
    """What decoding a picture takes.

    Args:
        data: the bytes of its file.
        head: what stands before the pixels of a JPEG file, if it is known.
    """
    if data.startswith(JPEG):
        head = head or jpeg_head(data)
        # To go through all of it for other markers would take as long as a twentieth of decoding it.
        scans = 1 if head.one_scan else sum(marker == START_OF_SCAN for marker, _ in jpeg_markers(data))
        return Cost(head.size, max(1, scans))
    slow = _is_iso(data) or _codestream(data) is not None
    return Cost(decoded_size(data), 1, _weight(data), len(data) if slow else 0)


def decoded_size(data: bytes) -> tuple[int, int] | None:
    """The size in `Cost`."""
    try:
        return stored_size(data) or _other_size(data)
    except (struct.error, ValueError):  # the header is cut off
        return None


def _weight(data: bytes) -> float:
    """The weight in `Cost`, of any picture but JPEG."""
    if data[:4] in TIFF:
        try:
            tags = tiff_tags(data, _BITS, _SAMPLES)
        except (struct.error, ValueError):
            return 1.0
        return float(max(1, tags.get(_BITS, 8) * min(tags.get(_SAMPLES, 1), 64) // 48))  # a pixel may have many numbers
    if (at := _codestream(data)) is not None:
        return max(1.0, int.from_bytes(data[at + 40 : at + 42]) / 3)  # of 32 bits, however many it says
    return HEAVY if _is_iso(data) or data[:2] in _FLOATS else 1.0


def is_deep(data: bytes) -> bool:
    """Whether a PNG, TIFF, Netpbm or JPEG 2000 picture has more than 8 bits, which OpenCV takes for 16."""
    try:
        if data.startswith(PNG):
            return data[24:25] == b"\x10"
        if data[:4] in TIFF:
            return tiff_tags(data, _BITS).get(_BITS) == 16
        if found := _NETPBM_DEPTH.match(data[:_HEAD]):
            return int(found[1]) > 255
        return (at := _codestream(data)) is not None and (data[at + 42] & 0x7F) > 7
    except (struct.error, ValueError, IndexError):  # the header is cut off
        return False


def _other_size(data: bytes) -> tuple[int, int] | None:
    if data[:4] in TIFF:
        return _tiff_size(data)
    if data[:4] == b"GIF8":
        width, height = struct.unpack_from("<HH", data, 6)
        return width, height
    if _is_iso(data):
        # The boxes may say anything.
        sizes = [*coded_sizes(data), *filter(None, [largest_item(data)])]
        return max(sizes, key=lambda size: size[0] * size[1], default=None)
    if (at := _codestream(data)) is not None:
        right, bottom, left, top = struct.unpack_from(">IIII", data, at + 8)
        return max(0, right - left), max(0, bottom - top)
    if data[:4] == _SUN:
        width, height = struct.unpack_from(">II", data, 4)
        return width, height
    for form, swapped in ((_NETPBM, False), (_PAM, False), (_RADIANCE, True)):
        if found := form.match(data[:_HEAD]):
            first, second = int(found[1]), int(found[2])
            return (second, first) if swapped else (first, second)
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    tags = tiff_tags(data, _WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_HEIGHT)
    width, height = tags.get(_WIDTH, 0), tags.get(_HEIGHT, 0)
    # A small picture may be cut from a tile of any size.
    tile = (tags.get(_TILE_WIDTH, 0), tags.get(_TILE_HEIGHT, 0))
    return max((width, height), tile, key=lambda size: size[0] * size[1])


def tiff_tags(data: bytes, *wanted: int) -> dict[int, int]:
    """The numbers in the first directory of a TIFF file by their tags, of those that are wanted; of several numbers, or
    tags, the first.

    Raises:
        struct.error, ValueError: it is cut off.
    """
    order, large = TIFF[data[:4]], data[2:4] in (b"+\0", b"\0+")

    def offset(at: int) -> int:
        """The place in the file that stands at another, which may be any number of 64 bits."""
        (place,) = struct.unpack_from(f"{order}Q" if large else f"{order}I", data, at)
        if place > len(data):
            raise ValueError("a place behind the end")
        return int(place)

    first = offset(8 if large else 4)
    (count,) = struct.unpack_from(f"{order}Q" if large else f"{order}H", data, first)
    entry, size, inline = (f"{order}HHQ", 20, 8) if large else (f"{order}HHI", 12, 4)
    first += 8 if large else 2
    found: dict[int, int] = {}
    for number in range(min(count, 4096)):
        at = first + size * number
        tag, kind, several = struct.unpack_from(entry, data, at)
        if tag not in wanted or tag in found or kind not in _NUMBERS or not several:
            continue
        at += size - inline
        if struct.calcsize(_NUMBERS[kind]) * several > inline:
            at = offset(at)
        (found[tag],) = struct.unpack_from(f"{order}{_NUMBERS[kind]}", data, at)
    return found


def _is_iso(data: bytes) -> bool:
    """Whether a file is HEIC or AVIF."""
    return data[4:8] == b"ftyp" and data[8:12] in ISO_PICTURES


def _codestream(data: bytes) -> int | None:
    """Where the pixels of a JPEG 2000 file begin, with their size; None of other files."""
    if data.startswith(_CODESTREAM):
        return 0
    if data[4:8] != b"jP  ":
        return None
    at = 0
    for _ in range(_MOST_BOXES):  # they say how long they are
        if at + 16 > len(data):
            break
        size, kind = struct.unpack_from(">I4s", data, at)
        size, head = (struct.unpack_from(">Q", data, at + 8)[0], 16) if size == 1 else (size, 8)
        if kind == b"jp2c":  # decoders pass over other segments, which are not looked at here: they could say anything
            return at + head if data.startswith(_CODESTREAM, at + head) else None
        if size < head:
            break
        at += size
    return None
