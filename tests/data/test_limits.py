"""Small files that become large pictures, or much work, are refused by their headers; damage has a name."""

import os
import signal
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from jaxfit.data import damage, limits
from jaxfit.data.limits import DEFAULT_MEGAPIXELS, at_most_megapixels, counted_together, most_megapixels
from jaxfit.data.pictures import decode_image, find_images, read_grey, read_image
from jaxfit.data.sizes import cost_of, decoded_size
from jaxfit.data.threads import in_order, interruptible
from jaxfit.errors import ImageError, InputError


def encoded(suffix: str, shape: tuple[int, ...] = (60, 80, 3), dtype: type = np.uint8, **of: int) -> bytes:
    noise = np.random.default_rng(3).integers(0, np.iinfo(dtype).max, shape).astype(np.float32)
    smooth: np.ndarray = cv2.GaussianBlur(noise, (0, 0), 4).astype(dtype)
    options = [value for name, number in of.items() for value in (getattr(cv2, f"IMWRITE_{name}"), number)]
    return cv2.imencode(suffix, smooth, options)[1].tobytes()


WRITTEN = (
    ".jpg",
    ".png",
    ".webp",
    ".bmp",
    ".tiff",
    ".gif",
    ".avif",
    ".jp2",
    ".ppm",
    ".pgm",
    ".pam",
    ".pfm",
    ".hdr",
    ".sr",
)


@pytest.mark.parametrize("suffix", WRITTEN)
def test_sizes_of_all_formats_stand_in_their_headers(suffix: str) -> None:
    picture = np.zeros((60, 80, 3), np.float32 if suffix in (".hdr", ".pfm") else np.uint8)
    picture = picture[..., 0] if suffix == ".pgm" else picture
    data = cv2.imencode(suffix, picture)[1].tobytes()
    assert decoded_size(data) == (80, 60)
    with (
        at_most_megapixels(0.004),
        pytest.raises(ImageError, match=r"80 x 60 pixels .* 0 megapixels; expected at most"),
    ):
        decode_image(data)
    assert decode_image(data).shape == (60, 80, 3)


def png(width: int, height: int) -> bytes:
    """A PNG file of one bit a pixel, without its pixels."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)), (b"IDAT", b""), (b"IEND", b"")]
    chunks = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def tiff(tags: dict[int, int], large: bool = False, order: str = "<") -> bytes:
    """The head of a TIFF file with numbers of 32 bits."""
    mark = b"II" if order == "<" else b"MM"
    if large:
        head = mark + struct.pack(f"{order}HHHQ", 43, 8, 0, 16) + struct.pack(f"{order}Q", len(tags))
        return head + b"".join(struct.pack(f"{order}HHQII", tag, 4, 1, value, 0) for tag, value in tags.items())
    head = mark + struct.pack(f"{order}HIH", 42, 8, len(tags))
    return head + b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in tags.items())


def codestream(side: int, numbers: int) -> bytes:
    """The head of JPEG 2000's pixels."""
    return b"\xff\x4f\xff\x51\0\x2f\0\0" + struct.pack(">8IH", side, side, 0, 0, side, side, 0, 0, numbers)


def box(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", 8 + len(data)) + kind + data


SIDE = 40_000  # 1,600 megapixels
BOMBS: dict[str, bytes] = {
    "PNG": png(SIDE, SIDE),
    "WebP": b"RIFF\0\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + b"\x3f\x9c\0" * 2,
    "GIF": b"GIF89a" + struct.pack("<HH", SIDE, SIDE) + bytes(20),
    "TIFF": tiff({256: SIDE, 257: SIDE}),
    "TIFF, the other order": tiff({256: SIDE, 257: SIDE}, order=">"),
    "BigTIFF": tiff({256: SIDE, 257: SIDE}, large=True),
    "TIFF of one tile": tiff({256: 10, 257: 10, 322: SIDE, 323: SIDE}),
    "TIFF of many numbers a pixel": tiff({256: 8000, 257: 8000, 258: 64, 277: 16}),
    "Netpbm, floats": b"PF\n9000 9000\n-1\n",
    "BMP": b"BM" + bytes(12) + struct.pack("<Iii", 40, SIDE, -SIDE) + bytes(40),
    "AVIF": b"\0\0\0\x18ftypavif" + bytes(12) + b"ispe\0\0\0\0" + struct.pack(">II", SIDE, SIDE),
    "AVIF, smaller": b"\0\0\0\x18ftypavif" + bytes(12) + b"ispe\0\0\0\0" + struct.pack(">II", 9000, 9000),
    "JPEG 2000": codestream(SIDE, 3),
    "JPEG 2000 of many numbers a pixel": codestream(8000, 16),
    "JPEG 2000 behind another": b"\0\0\0\x0cjP  \r\n\x87\n"
    + box(b"free", codestream(8, 3))
    + box(b"jp2c", codestream(SIDE, 3)),
    "Netpbm": b"P4 # a comment\n40000 # more\n 40000\n",
    "PAM": b"P7\nDEPTH 3\nWIDTH 40000\nHEIGHT 40000\nENDHDR\n",
    "Radiance": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 40000 +X 40000\n",
    "Sun": b"\x59\xa6\x6a\x95" + struct.pack(">II", SIDE, SIDE),
    "JPEG": b"\xff\xd8\xff\xc0\0\x11\x08" + struct.pack(">HH", SIDE, SIDE) + bytes(12) + b"\xff\xd9",
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_by_their_headers(name: str) -> None:
    with pytest.raises(
        ImageError, match=rf"megapixels; expected at most {DEFAULT_MEGAPIXELS:g}: shrink it, or allow more"
    ):
        decode_image(BOMBS[name])


def test_sizes_that_a_decoder_may_not_take_are_not_believed() -> None:
    """OpenJPEG passes over segments that it does not know, whatever they seem to say."""
    pixels = encoded(".jp2")
    at = pixels.index(b"jp2c") + 4
    unknown = b"\xff\x6f" + codestream(8, 3)[4:49]
    hidden = pixels[: at + 2] + unknown + pixels[at + 2 :]
    assert decoded_size(pixels) is not None
    assert decoded_size(hidden) is None
    with pytest.raises(ImageError, match="not a picture"):
        decode_image(hidden)


def test_scans_of_a_jpeg_are_counted() -> None:
    usual = encoded(".jpg", JPEG_PROGRESSIVE=1)
    assert 5 < cost_of(usual).scans < 15
    assert cost_of(encoded(".jpg")).scans == 1
    colours = encoded(".jpg").replace(b"\xff\xda\0\x0c\x03", b"\xff\xda\0\x08\x01")  # each in its own scan
    at = colours.rindex(b"\xff\xda")
    assert cost_of(colours[:at] + colours[at:-2] * 200 + colours[-2:]).scans == 200
    decode_image(usual)
    at = usual.rindex(b"\xff\xda")  # the last scan, again and again
    bomb = usual[:at] + usual[at:-2] * 200 + usual[-2:]
    begun = time.monotonic()
    with pytest.raises(ImageError, match=r"progressive JPEG of 2\d\d scans .* takes too long"):
        decode_image(bomb)
    assert time.monotonic() - begun < 1


@pytest.mark.parametrize("suffix", [".avif", ".jp2"])
def test_files_whose_bytes_take_long_are_small(suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = encoded(suffix)
    monkeypatch.setattr(limits, "MOST_SLOW_BYTES", len(data))
    decode_image(data)
    monkeypatch.setattr(limits, "MOST_SLOW_BYTES", len(data) - 1)
    with pytest.raises(ImageError, match="bytes in this format takes too long; save it as JPEG or PNG"):
        decode_image(data)


def test_limits_reach_threads_and_end() -> None:
    with at_most_megapixels(7.0):
        assert list(in_order([most_megapixels] * 4, 2)) == [7] * 4
    assert list(in_order([most_megapixels] * 4, 2)) == [DEFAULT_MEGAPIXELS] * 4
    for wrong in (0.0, -1.0, 1001.0, float("nan")):
        with pytest.raises(InputError, match="megapixels a picture"), at_most_megapixels(wrong):
            pass


def test_pictures_in_memory_are_no_more_than_one_may_be() -> None:
    """In all threads together; whoever reads two does not wait for itself, and errors give the room back."""
    data, inside, most = encoded(".png"), 0, 0

    def read(number: int) -> None:
        nonlocal inside, most
        with suppress(ImageError), at_most_megapixels(0.01), counted_together():
            decode_image(data)
            inside += 1
            most = max(most, inside)
            time.sleep(0.01)
            inside -= 1
            decode_image(data[:-20] if number % 2 else data)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(read, range(20)))
    assert most == 2  # of 4,800 pixels


def test_files_are_as_large_as_pictures_may_be(tmp_path: Path) -> None:
    path = tmp_path / "terabyte.jpg"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(ImageError, match=r"terabyte\.jpg: cannot be read \(expected a file of at most 1,507,"):
        read_image(path)


def zeroed(data: bytes) -> bytes:
    """The middle third of a file is lost."""
    third = len(data) // 3
    return data[:third] + bytes(third) + data[2 * third :]


@pytest.mark.parametrize("read", [read_image, read_grey])
def test_a_jpeg_that_lost_its_middle_is_damaged(
    read: Callable[[Path], Any], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lost.jpg"
    path.write_bytes(zeroed(encoded(".jpg", (400, 400, 3))))
    with pytest.raises(ImageError, match=r"lost\.jpg: damaged \(Corrupt JPEG data: .*\); copy or download it again"):
        read(path)
    assert capfd.readouterr().err == ""


def test_bytes_too_many_are_no_damage(capfd: pytest.CaptureFixture[str]) -> None:
    """As some cameras write them."""
    data = encoded(".jpg")
    padded = data[:-2] + bytes(9) + data[-2:]
    np.testing.assert_array_equal(decode_image(padded), decode_image(data))
    assert capfd.readouterr().err == ""


def test_what_threads_print_at_once_does_not_lie_over_each_other() -> None:
    with damage._in_memory() as file, ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda number: [os.write(file.fileno(), b"%08d" % number) for _ in range(2000)], range(4)))
        file.seek(0)
        said = file.read()
    assert all(said.count(b"%08d" % number) == 2000 for number in range(4))


def test_damage_is_told_of_its_picture_alone(capfd: pytest.CaptureFixture[str]) -> None:
    """Eight threads decode at once, and others print meanwhile."""
    good = encoded(".jpg", (400, 400, 3))
    bad = zeroed(good)

    def why(number: int) -> str:
        os.write(2, f"<{number}>".encode())
        try:
            decode_image(bad if number % 5 == 0 else good, source=f"{number}.jpg")
        except ImageError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor(8) as pool:
        said = list(pool.map(why, range(60)))
    for number, words in enumerate(said):
        assert words.startswith(f"{number}.jpg: damaged") == (number % 5 == 0)
        assert bool(words) == (number % 5 == 0)
    err = capfd.readouterr().err
    assert "JPEG" not in err
    # A write that is under way while the standard error is given back may be lost: few are.
    printed = err.replace(">", "").split("<")[1:]
    assert {*printed} <= {str(number) for number in range(60)}
    assert 55 <= len(printed) <= 60


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with names")
def test_only_regular_files_are_read(tmp_path: Path) -> None:
    """Neither for ever nor waiting; and what is called like a picture is reported, whatever it is."""
    (tmp_path / "good.png").write_bytes(encoded(".png"))
    os.mkfifo(tmp_path / "pipe.jpg")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros.jpg").symlink_to("/dev/zero")
    (tmp_path / "round").symlink_to(tmp_path, target_is_directory=True)
    found = find_images([tmp_path], recursive=True)
    assert [path.name for path in found] == ["good.png", "pipe.jpg", "zeros.jpg"]
    for path in found[1:]:
        with pytest.raises(ImageError, match="a device or pipe, and not a regular file"):
            read_image(path)


@pytest.fixture
def _interrupts() -> Iterator[None]:
    """Ctrl-C is heard, also where a shell started the tests in the background, deaf to it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_interrupts")
def test_the_main_thread_hears_ctrl_c_while_others_decode() -> None:
    go = threading.Event()
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interruptible(lambda: go.wait(20))
    pieces = in_order([lambda: None, *[lambda: go.wait(20)] * 3], 2)
    next(pieces)
    with pytest.raises(KeyboardInterrupt), closing(pieces):
        raise KeyboardInterrupt  # in whoever takes the results
    assert time.monotonic() - begun < 2
    go.set()


@pytest.mark.parametrize("film", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_the_size_of_avif_is_that_of_its_pixels_whatever_its_boxes_say(
    channels: int, film: bool, tmp_path: Path
) -> None:
    picture: np.ndarray = np.zeros((3000, 4000) if channels == 1 else (3000, 4000, channels), np.uint8)
    if film and channels > 1:
        frames = cv2.Animation()
        frames.frames, frames.durations = [picture, picture + 9], [100, 100]
        cv2.imwriteanimation(str(tmp_path / "film.avif"), frames, [cv2.IMWRITE_AVIF_SPEED, 10])
        data = (tmp_path / "film.avif").read_bytes()
    else:
        data = cv2.imencode(".avif", picture, [cv2.IMWRITE_AVIF_SPEED, 10])[1].tobytes()
    called = data.replace(struct.pack(">II", 4000, 3000), struct.pack(">II", 64, 64))
    assert called != data
    assert decoded_size(called) == (4000, 3000)
    with at_most_megapixels(20.0), pytest.raises(ImageError, match=r"4000 x 3000 pixels .* count as 30 mega"):
        decode_image(called)
    for cut in range(0, len(data), 7):
        assert decoded_size(data[:cut]) in (None, (4000, 3000))


def test_avif_that_would_take_long_to_look_through_has_no_size() -> None:
    def places(version: int, count: int, extents: int, length: int) -> bytes:
        item = struct.pack(">HHHH", 1, 0, 0, extents) + struct.pack(">II", 0, length) * min(extents, 100)
        listed = struct.pack(">BBHBBH", version, 0, 0, 0x44, 0, count) + item * count
        head = b"\0\0\0\x18ftypavif" + bytes(12)
        return head + box(b"meta", bytes(4) + box(b"iloc", listed)) + box(b"mdat", b"\x12\0" * 100_000)

    begun = time.process_time()
    for wrong in (places(1, 5000, 1, 10), places(1, 4000, 1, 100_000), places(1, 1, 65_535, 0), places(1, 1, 1, 0)):
        assert decoded_size(wrong) is None
    assert time.process_time() - begun < 1
