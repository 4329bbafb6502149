"""What pictures say before they are decoded: what they are, their sizes, and the segments of JPEG."""

import re
import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

JPEG = b"\xff\xd8"
PNG = b"\x89PNG\r\n\x1a\n"
_HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1")
ISO_PICTURES = (*_HEIC_BRANDS, b"avif", b"avis")
# How other files of pictures begin; of bitmaps and Netpbm's more has to be right, as words may begin so.
_BEGINNINGS = re.compile(
    rb"GIF8[79]a|II[*+]\0|MM\0[*+]|RIFF....WEBP|BM....\0{4}....[\x0c\x28\x34\x38\x40\x6c\x7c]\0{3}|"
    rb"P[1-6]\s+(#|\d+\s+\d+\s)|P7\s+WIDTH|P[Ff]\n|"
    rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51|\0\0\0\x0cJXL |\xff\x0a|#\?RADIANCE|v/1\x01|8BPS|\x59\xa6\x6a\x95",
    re.DOTALL,
)
BEGINNING = 64  # bytes of a file that tell whether it is a picture
END_OF_IMAGE, START_OF_SCAN, _APPLICATION_1 = 0xD9, 0xDA, 0xE1
EXIF = b"Exif\0\0"  # begins EXIF data in JPEG
_START_OF_FRAME = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # three of this range are tables
_SEQUENTIAL = (0xC0, 0xC1, 0xC9)  # of them
_MARK = 0xFF  # begins a marker
# Behind it, a zero (the byte 0xff itself), a restart marker or a fill byte go on with the current scan; 0x01 has no
# segment either.
_NO_MARKERS = {0x00, 0x01, 0xFF, *range(0xD0, 0xD8)}
_MARKER = re.compile(rb"\xff([^\x00\x01\xff\xd0-\xd7])", re.DOTALL)


def looks_like_picture(data: bytes) -> bool:
    """Whether a file begins like one of a picture, of any format: also of those that OpenCV does not read.

    Args:
        data: its first ``BEGINNING`` bytes, or more.
    """
    if data[4:8] == b"ftyp":
        return data[8:12] in ISO_PICTURES
    return data.startswith((JPEG + b"\xff", PNG)) or _BEGINNINGS.match(data) is not None


def is_heic(data: bytes) -> bool:
    """Whether a file begins like one of a HEIC picture, and not like another of its family, such as AVIF."""
    return data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS and not is_avif(data)


def is_avif(data: bytes) -> bool:
    """Whether a file begins like one of an AVIF picture, or of several."""
    brands = data[8:BEGINNING]
    return data[4:8] == b"ftyp" and (b"avif" in brands or b"avis" in brands)


def stored_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels, as stored, of a JPEG, PNG, WebP, BMP or HEIC picture; None for all else.

    They are what the header promises: the picture may be damaged all the same.
    """
    try:
        if data.startswith(JPEG):
            return jpeg_head(data).size
        if data.startswith(PNG) and data[12:16] == b"IHDR":
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp_size(data)
        if data.startswith(b"BM"):
            return _bmp_size(data)
        if is_heic(data):
            return largest_item(data)
    except struct.error:  # the header is cut off
        pass
    return None


def jpeg_markers(data: bytes) -> Iterator[tuple[int, int]]:
    """The markers of a JPEG file after its first, each with the place of what follows it.

    Segments are stepped over, and the markers of embedded thumbnails with them.
    """
    at, last = len(JPEG), len(data) - 2
    while True:
        if at <= last and data[at] == _MARK and data[at + 1] not in _NO_MARKERS:  # as in most files, and quicker
            marker, at = data[at + 1], at + 2
        elif found := _MARKER.search(data, at):
            marker, at = found[1][0], found.end()
        else:
            return
        yield marker, at
        # Every marker but the last, start of scan included, heads a segment that gives its own length.
        at += int.from_bytes(data[at : at + 2])


def has_jpeg_header(data: bytes) -> bool:
    """Whether a file's beginning holds all that stands before the pixels of a JPEG picture."""
    return data.startswith(JPEG) and any(marker == START_OF_SCAN for marker, _ in jpeg_markers(data))


class JpegHead(NamedTuple):
    """What stands before the pixels of a JPEG file.

    Attributes:
        size: width and height in pixels, as stored; None if it is cut off.
        one_scan: it is neither progressive nor has a scan for each colour: what comes after its scan is not decoded.
        exif: its EXIF data, which may be several, and empty.
    """

    size: tuple[int, int] | None
    one_scan: bool
    exif: Sequence[bytes]


def jpeg_head(data: bytes) -> JpegHead:
    """What stands before the pixels of a JPEG file."""
    size, colours, one_scan = None, b"", False
    exif: list[bytes] = []
    for marker, at in jpeg_markers(data):
        if marker in _START_OF_FRAME:
            one_scan = size is None and marker in _SEQUENTIAL  # two frames are damage
            size = size or _frame_size(data, at)
            colours = data[at + 7 : at + 8]
        elif marker == _APPLICATION_1 and data.startswith(EXIF, at + 2):
            exif.append(data[at + 2 + len(EXIF) : at + int.from_bytes(data[at : at + 2])])
        elif marker == START_OF_SCAN:
            return JpegHead(size, one_scan and data[at + 2 : at + 3] == colours, exif)
        elif marker == END_OF_IMAGE:
            break
    return JpegHead(size, False, exif)


def _frame_size(data: bytes, at: int) -> tuple[int, int] | None:
    if len(data) < at + 7:
        return None
    height, width = struct.unpack_from(">HH", data, at + 3)
    return width, height


def _webp_size(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":  # extended: the size of the canvas, less one, in 24 bits each
        low, middle, high = struct.unpack_from("<HHH", data, 24)
        return 1 + (low | (middle & 0xFF) << 16), 1 + (middle >> 8 | high << 8)
    if kind == b"VP8L" and data[20:21] == b"\x2f":  # lossless: 14 bits each
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 " and data[23:26] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _bmp_size(data: bytes) -> tuple[int, int]:
    (header,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", data, 18)
    return abs(width), abs(height)  # negative heights: the first row is the upper one


def largest_item(data: bytes) -> tuple[int, int] | None:
    """Width and height of the largest of the pictures in a HEIC or AVIF file: tiles, thumbnails and the whole."""
    sizes = [struct.unpack_from(">II", data, found.end() + 4) for found in re.finditer(b"ispe", data)]
    return max(sizes, key=lambda size: size[0] * size[1], default=None)
