"""Pictures whose EXIF data turn them."""

import struct
from collections.abc import Callable

import numpy as np

# By EXIF orientation: what makes the seen picture of the stored one.
TURNS: dict[int, Callable[[np.ndarray], np.ndarray]] = {
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


def stored(seen: np.ndarray, orientation: int) -> np.ndarray:
    """The picture to store so that ``seen`` is seen."""
    return np.ascontiguousarray(TURNS[_UNDONE_BY.get(orientation, orientation)](seen))


def with_segment(jpeg: bytes, payload: bytes) -> bytes:
    """The picture with an application segment behind its first marker."""
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + jpeg[2:]


def oriented(jpeg: bytes, orientation: int) -> bytes:
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    return with_segment(jpeg, b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<H", 1) + entry + b"\0" * 4)
