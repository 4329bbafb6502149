"""The sizes that headers promise, against the sizes that OpenCV decodes."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="call-arg,union-attr"

import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfit.data.headers import stored_size

LOSSLESS_WEBP = (cv2.IMWRITE_WEBP_QUALITY, 101)
WAYS = [
    (".jpg", ()),
    (".jpg", (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)),
    (".png", ()),
    (".bmp", ()),
    (".webp", (cv2.IMWRITE_WEBP_QUALITY, 80)),
    (".webp", LOSSLESS_WEBP),
]


def encoded(suffix: str, options: tuple, shape: tuple[int, ...]) -> bytes:
    pixels = np.random.default_rng(3).integers(0, 256, shape).astype(np.uint8)
    return cv2.imencode(suffix, pixels, options)[1].tobytes()


@pytest.mark.parametrize(("suffix", "options"), WAYS)
@pytest.mark.parametrize("shape", [(1, 1, 3), (3, 700, 3), (301, 5), (257, 300, 3)])
def test_headers_promise_what_is_decoded(suffix: str, options: tuple, shape: tuple[int, ...]) -> None:
    data = encoded(suffix, options, shape)
    assert stored_size(data) == cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED).shape[1::-1]


def test_extended_webp() -> None:
    data = encoded(".webp", LOSSLESS_WEBP, (70, 90, 4))
    canvas = struct.pack("<BBBB", 0x10, 0, 0, 0) + (699_999).to_bytes(3, "little") + (300_000).to_bytes(3, "little")
    extended = data[:12] + b"VP8X" + struct.pack("<I", 10) + canvas + data[12:]
    assert stored_size(extended) == (700_000, 300_001)


def test_bitmaps_from_the_top_and_of_old() -> None:
    start = b"BM" + bytes(12)
    assert stored_size(start + struct.pack("<Iii", 40, 640, -480)) == (640, 480)
    assert stored_size(start + struct.pack("<IHH", 12, 640, 480)) == (640, 480)


def test_a_thumbnail_is_not_the_picture() -> None:
    data, thumbnail = encoded(".jpg", (), (120, 160, 3)), encoded(".jpg", (), (12, 16, 3))
    whole = data[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + data[2:]
    assert stored_size(whole) == (160, 120)


@pytest.mark.parametrize("data", [b"", b"GIF89a" + bytes(30), b"II*\0" + bytes(30), b"\xff\xd8\xff\xda\0\2" + bytes(9)])
def test_other_files_promise_nothing(data: bytes) -> None:
    assert stored_size(data) is None


@given(way=st.sampled_from(WAYS), kept=st.integers(0, 40), noise=st.binary(max_size=60))
def test_damaged_headers_raise_nothing(way: tuple, kept: int, noise: bytes) -> None:
    size = stored_size(encoded(*way, (9, 9, 3))[:kept] + noise)
    assert size is None or min(size) >= 0
