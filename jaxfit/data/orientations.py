"""How pictures are turned and mirrored to be seen, as their files say, and doing it.

Orientations are numbered as in EXIF: 1, seen as stored, to 8.
"""

import struct
from collections.abc import Callable, Iterator

import numpy as np

from jaxfit.data.avif import boxes_in, each_box
from jaxfit.data.headers import EXIF, JPEG, PNG, JpegHead, is_avif, jpeg_head
from jaxfit.data.sizes import TIFF, tiff_tags

SIDEWAYS = (5, 6, 7, 8)  # the orientations that exchange width and height
_ORIENTATION = 0x0112  # the tag of TIFF and EXIF
# What makes the seen picture of the stored one, and the stored of the seen.
_TURNS: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda picture: picture,
    2: np.fliplr,
    3: lambda picture: np.rot90(picture, 2),
    4: np.flipud,
    5: lambda picture: picture.swapaxes(0, 1),
    6: lambda picture: np.rot90(picture, -1),
    7: lambda picture: np.rot90(picture, 2).swapaxes(0, 1),
    8: np.rot90,
}
_UNDONE_BY = {6: 8, 8: 6}  # all others undo themselves


def orientation_of(data: bytes, head: JpegHead | None = None) -> int:
    """How a picture in a file is turned to be seen, from 1 to 8: a JPEG, PNG or WebP picture as its EXIF data say, TIFF
    by a tag, AVIF by properties of its own, whatever its EXIF data say; 1 for all else.

    HEIC pictures are turned by their decoder: no program sees them as they are stored.

    Args:
        data: the bytes of the file.
        head: what stands before the pixels of a JPEG file, if it is known.
    """
    try:
        if data[:4] in TIFF:
            return _of_tags(data)
        if is_avif(data):
            return _of_properties(data)
        for exif in _exif(data, head):
            if exif[:4] in TIFF:  # an empty one may come before
                return _of_tags(exif)
    except (struct.error, ValueError, IndexError):  # cut off
        pass
    return 1


def as_seen(stored: np.ndarray, orientation: int) -> np.ndarray:
    """The picture (H, W, ...) that is seen where this one is stored, contiguous."""
    return np.ascontiguousarray(_TURNS[orientation](stored))


def as_stored(seen: np.ndarray, orientation: int) -> np.ndarray:
    """The picture (H, W, ...) that is stored where this one is seen, contiguous."""
    return as_seen(seen, _UNDONE_BY.get(orientation, orientation))


def _of_tags(data: bytes) -> int:
    """The orientation in the first directory of a TIFF file; EXIF data are such a file."""
    value = tiff_tags(data, _ORIENTATION).get(_ORIENTATION, 1)
    return value if value in _TURNS else 1


def _exif(data: bytes, head: JpegHead | None) -> Iterator[bytes]:
    """The EXIF data of a JPEG, PNG or WebP picture, if it has some."""
    if data.startswith(JPEG):
        yield from (head or jpeg_head(data)).exif
    elif data.startswith(PNG) and b"eXIf" in data:
        at = len(PNG)
        while at + 8 <= len(data):
            size, kind = struct.unpack_from(">I4s", data, at)
            if kind == b"eXIf":
                yield data[at + 8 : at + 8 + size]
            at += 12 + size
    elif data.startswith(b"RIFF") and data[8:12] == b"WEBP" and b"EXIF" in data:
        at = 12
        while at + 8 <= len(data):
            kind, size = struct.unpack_from("<4sI", data, at)
            if kind == b"EXIF":
                yield data[at + 8 : at + 8 + size].removeprefix(EXIF)
            at += 8 + size + size % 2


def _of_properties(data: bytes) -> int:
    """The orientation of an AVIF picture: its main item is turned by ``irot``, then mirrored by ``imir``."""
    boxes = boxes_in(boxes_in(data).get(b"meta", b"")[4:])
    properties = boxes_in(boxes.get(b"iprp", b""))
    main = boxes.get(b"pitm", b"")
    item = int.from_bytes(main[4:6] if main[:1] == b"\0" else main[4:8])
    kept = list(each_box(properties.get(b"ipco", b"")))
    turns = 0
    axis: int | None = None
    for number in _property_numbers(properties.get(b"ipma", b""), item):
        kind, body = kept[number - 1] if 0 < number <= len(kept) else (b"", b"")
        if kind == b"irot":
            turns = body[0] & 3  # quarters, anticlockwise
        elif kind == b"imir":
            axis = body[0] & 1  # 0 exchanges above and below, 1 left and right
    if axis is None:
        return (1, 8, 3, 6)[turns]
    return ((4, 5, 2, 7), (2, 7, 4, 5))[axis][turns]


def _property_numbers(data: bytes, wanted: int) -> Iterator[int]:
    """The numbers, from 1, of the properties of an item, as the box ``ipma`` lists them."""
    version, large = data[0], data[3] & 1
    (count,) = struct.unpack_from(">I", data, 4)
    at = 8
    for _ in range(count):
        item, several = struct.unpack_from(">HB" if version == 0 else ">IB", data, at)
        at += 3 if version == 0 else 5
        numbers = struct.unpack_from(f">{several}{'H' if large else 'B'}", data, at)
        at += several * (2 if large else 1)
        if item == wanted:
            yield from (number & (0x7FFF if large else 0x7F) for number in numbers)
