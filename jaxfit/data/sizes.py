"""How large pictures of all formats that are read become when they are decoded, as their first bytes say."""

import re
import struct

from jaxfit.data.headers import ISO_PICTURES, JPEG, PNG, START_OF_SCAN, jpeg_markers, largest_item, stored_size

TIFF = {b"II*\0": "<", b"MM\0*": ">", b"II+\0": "<", b"MM\0+": ">"}  # the order of bytes; with a plus, large files
_WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 277, 322, 323
_NUMBERS = {1: "B", 3: "H", 4: "I", 16: "Q"}  # TIFF's types of whole numbers
_NETPBM = re.compile(rb"P[1-6Ff](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")
_NETPBM_DEPTH = re.compile(rb"P[2356](?:(?:\s|#[^\n]*\n)+\d{1,9}){2}(?:\s|#[^\n]*\n)+(\d{1,9})\s")
_PAM = re.compile(rb"P7\s.*?WIDTH\s+(\d{1,9}).*?HEIGHT\s+(\d{1,9})", re.DOTALL)
_RADIANCE = re.compile(rb"#\?.*?\n\n[+-]Y (\d{1,9}) [+-]X (\d{1,9})\n", re.DOTALL)
_SUN = b"\x59\xa6\x6a\x95"
_CODESTREAM = b"\xff\x4f\xff\x51"  # JPEG 2000
_HEAD = 8192  # bytes that headers of text may take; looking through them takes the square


def decoded_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels of what a decoder would make of a picture, tiles of TIFF files included; None of what
    no decoder here reads."""
    try:
        return stored_size(data) or _other_size(data)
    except (struct.error, ValueError):  # the header is cut off
        return None


def scans_of(data: bytes) -> int:
    """How often a decoder goes through a picture: the scans of a JPEG file, 1 of all else."""
    if not data.startswith(JPEG):
        return 1
    return max(1, sum(marker == START_OF_SCAN for marker, _ in jpeg_markers(data)))


def is_deep(data: bytes) -> bool:
    """Whether a PNG, TIFF, Netpbm or JPEG 2000 picture has more than 8 bits, which OpenCV takes for 16."""
    try:
        if data.startswith(PNG):
            return data[24:25] == b"\x10"
        if data[:4] in TIFF:
            return tiff_tags(data, _BITS).get(_BITS) == 16
        if found := _NETPBM_DEPTH.match(data[:_HEAD]):
            return int(found[1]) > 255
        return _is_jpeg_2000(data) and (data[data.find(_CODESTREAM) + 42] & 0x7F) > 7
    except (struct.error, ValueError, IndexError):  # the header is cut off
        return False


def _is_jpeg_2000(data: bytes) -> bool:
    return data[:4] == _CODESTREAM or data[4:8] == b"jP  "


def _other_size(data: bytes) -> tuple[int, int] | None:
    if data[:4] in TIFF:
        return _tiff_size(data)
    if data[:4] == b"GIF8":
        width, height = struct.unpack_from("<HH", data, 6)
        return width, height
    if data[4:8] == b"ftyp" and data[8:12] in ISO_PICTURES:
        return largest_item(data)
    if _is_jpeg_2000(data):
        return _jpeg_2000_size(data)
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
    # A small picture may be cut from a tile of any size, and a pixel may have many numbers.
    tile = (tags.get(_TILE_WIDTH, 0), tags.get(_TILE_HEIGHT, 0))
    width, height = max((width, height), tile, key=lambda size: size[0] * size[1])
    return width * max(1, tags.get(_BITS, 8) * min(tags.get(_SAMPLES, 1), 64) // 48), height


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


def _jpeg_2000_size(data: bytes) -> tuple[int, int] | None:
    at = data.find(_CODESTREAM)
    if at < 0:
        return None
    right, bottom, left, top = struct.unpack_from(">IIII", data, at + 8)
    return max(0, right - left), max(0, bottom - top)
