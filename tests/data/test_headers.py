"""The sizes and orientations that headers promise, against those that OpenCV decodes."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="call-arg,union-attr"

import struct
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from exif_files import TURNS, oriented, with_segment
from hypothesis import given
from hypothesis import strategies as st

from jaxfit.data.headers import stored_size
from jaxfit.data.orientations import orientation_of
from jaxfit.data.pictures import decode_image
from jaxfit.data.sizes import decoded_size, is_deep

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


@pytest.mark.parametrize("first", [b"Exif\0\0", b"Exif\0\0junk" + bytes(9), b"http://ns.adobe.com/xmp/" + bytes(65000)])
def test_exif_data_may_stand_behind_other_segments(first: bytes) -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((8, 24, 3), np.uint8))[1].tobytes()
    data = with_segment(with_segment(oriented(jpeg, 6), first), first)
    assert orientation_of(data) == 6
    assert decode_image(data).shape == (24, 8, 3)


def _exif_of(orientation: int, order: str) -> bytes:
    start = b"II*\0" if order == "<" else b"MM\0*"
    return start + struct.pack(f"{order}IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)


def _png(exif: bytes, late: bool) -> bytes:
    png = cv2.imencode(".png", PICTURE)[1].tobytes()
    chunk = struct.pack(">I", len(exif)) + b"eXIf" + exif + struct.pack(">I", zlib.crc32(b"eXIf" + exif))
    at = len(png) - 12 if late else 33
    return png[:at] + chunk + png[at:]


def _webp(exif: bytes, late: bool) -> bytes:
    frame = cv2.imencode(".webp", PICTURE, (cv2.IMWRITE_WEBP_QUALITY, 101))[1].tobytes()[12:]
    height, width = PICTURE.shape[:2]
    canvas = struct.pack("<I", 8) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    body = b"WEBPVP8X" + struct.pack("<I", 10) + canvas + frame + b"EXIF" + struct.pack("<I", len(exif)) + exif
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _tiff(exif: bytes, late: bool, large: bool = False) -> bytes:
    order, orientation = ("<" if exif.startswith(b"II") else ">"), exif[18:20]
    height, width = PICTURE.shape[:2]
    begin = 16 if large else 8
    values = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 273: begin, 274: 0, 277: 1, 278: height}
    values[279] = width * height
    entries = b"".join(
        struct.pack(f"{order}HHQ" if large else f"{order}HHI", tag, 3, 1)
        + (orientation if tag == 274 else struct.pack(f"{order}H", value))
        + b"\0" * (6 if large else 2)
        for tag, value in values.items()
    )
    end = begin + width * height
    head = struct.pack(f"{order}HHHQ", 43, 8, 0, end) if large else struct.pack(f"{order}HI", 42, end)
    count = struct.pack(f"{order}Q" if large else f"{order}H", len(values))
    return exif[:2] + head + PICTURE[..., 0].tobytes() + count + entries + b"\0" * 8


def _large_tiff(exif: bytes, late: bool) -> bytes:
    return _tiff(exif, late, large=True)


def _avif(exif: bytes, late: bool) -> bytes:
    # The encoder turns the picture by AVIF's own properties, as the EXIF data say.
    encoded = cv2.imencodeWithMetadata(".avif", PICTURE, [cv2.IMAGE_METADATA_EXIF], [np.frombuffer(exif, np.uint8)])
    return encoded[1].tobytes()


PICTURE = np.random.default_rng(0).integers(0, 256, (6, 10, 3), np.uint8)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("made", [_png, _webp, _tiff, _large_tiff, _avif])
def test_orientations_are_those_that_pictures_are_read_by(
    made: Callable[[bytes, bool], bytes], late: bool, order: str
) -> None:
    plain = decode_image(made(_exif_of(1, order), late))
    for orientation, turn in TURNS.items():
        data = made(_exif_of(orientation, order), late)
        assert orientation_of(data) == orientation
        np.testing.assert_array_equal(decode_image(data), turn(plain))
        np.testing.assert_array_equal(decode_image(data, exif=False), plain)
        for cut in range(0, len(data), 7):
            assert 1 <= orientation_of(data[:cut]) <= 8
    assert orientation_of(made(_exif_of(9, order), late)) == 1


@given(
    made=st.sampled_from([_png, _webp, _tiff, _large_tiff, _avif]),
    order=st.sampled_from("<>"),
    changes=st.lists(st.tuples(st.integers(0, 500), st.integers(0, 255)), max_size=5),
)
def test_damaged_orientations_raise_nothing(
    made: Callable[[bytes, bool], bytes], order: str, changes: list[tuple[int, int]]
) -> None:
    data = bytearray(made(_exif_of(6, order), False))
    for at, value in changes:
        data[at % len(data)] = value
    for damaged in (bytes(data), bytes(data).replace(b"\0\0\0\0", b"\xff\xff\xff\xff")):
        assert 1 <= orientation_of(damaged) <= 8
        assert decoded_size(damaged) is None or min(decoded_size(damaged) or ()) >= 0
        assert is_deep(damaged) in (True, False)
