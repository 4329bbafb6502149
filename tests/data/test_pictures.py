"""Pictures from files: every kind that cameras and editors write, and every way to be broken."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from exif_files import TURNS, oriented, with_segment
from hypothesis import given
from hypothesis import strategies as st

from jaxfit.data.headers import exif_orientation
from jaxfit.data.pictures import (
    GreyPictures,
    decode_image,
    find_images,
    read_grey,
    read_image,
    to_grey,
    write_image,
)
from jaxfit.errors import ImageError, InputError

LOSSLESS = [".png", ".bmp", ".tif", ".tiff", ".webp"]


@pytest.fixture
def rgb():
    """Smooth, so that JPEG keeps it, and different under every rotation, mirroring and swap of channels."""
    y, x = np.mgrid[:48, :64]
    return np.stack([x * 3, y * 4, 120 + (x + y) // 2], axis=2).astype(np.uint8)


def encoded(rgb, suffix=".jpg", *options):
    return cv2.imencode(suffix, rgb[..., ::-1], options)[1].tobytes()


def read_bytes(folder, data, **options):
    (folder / "picture").write_bytes(data)
    return read_image(folder / "picture", **options)


@pytest.mark.parametrize("suffix", LOSSLESS)
def test_lossless_formats_come_back_as_written(tmp_path, rgb, suffix):
    if suffix == ".webp":  # OpenCV writes it lossless above quality 100 only
        (tmp_path / "a.webp").write_bytes(encoded(rgb, ".webp", cv2.IMWRITE_WEBP_QUALITY, 101))
    else:
        write_image(tmp_path / f"a{suffix}", rgb)
    np.testing.assert_array_equal(read_image(tmp_path / f"a{suffix}"), rgb)


@pytest.mark.parametrize("progressive", [0, 1])
def test_jpeg_comes_back_in_the_right_colours(tmp_path, rgb, progressive):
    picture = read_bytes(tmp_path, encoded(rgb, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, progressive))
    assert np.abs(picture.astype(int) - rgb).mean() < 3


def test_every_picture_becomes_eight_bit_rgb(tmp_path, rgb):
    alpha = np.dstack([rgb[..., ::-1], np.full(rgb.shape[:2], 7, np.uint8)])
    np.testing.assert_array_equal(read_bytes(tmp_path, cv2.imencode(".png", alpha)[1].tobytes()), rgb)
    deep = rgb[..., ::-1].astype(np.uint16) * 256 + 3
    np.testing.assert_array_equal(read_bytes(tmp_path, cv2.imencode(".png", deep)[1].tobytes()), rgb)
    grey = read_bytes(tmp_path, cv2.imencode(".png", rgb[..., 0])[1].tobytes())
    np.testing.assert_array_equal(grey, np.dstack([rgb[..., 0]] * 3))


@pytest.mark.parametrize(("orientation", "turn"), TURNS.items())
def test_exif_orientation_is_obeyed_or_not(tmp_path, rgb, orientation, turn):
    plain = encoded(rgb)
    stored = read_bytes(tmp_path, plain)
    np.testing.assert_array_equal(read_bytes(tmp_path, oriented(plain, orientation)), turn(stored))
    np.testing.assert_array_equal(read_bytes(tmp_path, oriented(plain, orientation), exif=False), stored)
    assert exif_orientation(oriented(plain, orientation)) == orientation


def test_grey_is_what_the_colours_give(tmp_path, rgb):
    bgr = rgb[..., ::-1]
    deep, alpha = bgr.astype(np.uint16) * 256 + 3, np.dstack([bgr, np.full(rgb.shape[:2], 7, np.uint8)])
    files = {
        "turned.jpg": oriented(encoded(rgb), 6),
        "progressive.jpg": encoded(rgb, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        "fine.jpg": encoded(rgb, ".jpg", cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
        **{f"plain{suffix}": encoded(rgb, suffix) for suffix in LOSSLESS},
        "deep.png": cv2.imencode(".png", deep)[1].tobytes(),
        "deep.tif": cv2.imencode(".tif", deep)[1].tobytes(),
        "alpha.png": cv2.imencode(".png", alpha)[1].tobytes(),
        "grey.png": cv2.imencode(".png", rgb[..., 0])[1].tobytes(),
    }
    for name, data in files.items():
        path = tmp_path / name
        path.write_bytes(data)
        away = np.abs(read_grey(path) - to_grey(read_image(path)).astype(int))
        # Colours are rounded on their way from JPEG's luminance, and may be cut off at black and white.
        assert away.mean() < (0.6 if path.suffix == ".jpg" else 1e-9), name
        assert away.max() <= 8, name
    # OpenCV's TIFF reader rounds 16 bits where others cut them off.
    deep_tif = read_grey(tmp_path / "deep.tif").astype(int)
    assert np.abs(deep_tif - cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)).max() <= 1
    for name in ("deep.png", "alpha.png", *(f"plain{suffix}" for suffix in LOSSLESS)):
        expected = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        np.testing.assert_array_equal(read_grey(tmp_path / name), expected, err_msg=name)
    np.testing.assert_array_equal(read_grey(tmp_path / "grey.png"), rgb[..., 0])


@pytest.mark.parametrize("share", [0.3, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_truncated_files_are_refused(tmp_path, rgb, suffix, share):
    data = encoded(rgb, suffix)
    with pytest.raises(ImageError, match=r"picture: the file is truncated"):
        read_bytes(tmp_path, data[: int(len(data) * share)])


@pytest.mark.parametrize("suffix", [".bmp", ".tif", ".webp"])
def test_other_truncated_files_are_refused(tmp_path, rgb, suffix, capfd):
    data = encoded(rgb, suffix)
    with pytest.raises(ImageError, match="picture"):
        read_bytes(tmp_path, data[: len(data) // 2])
    assert capfd.readouterr() == ("", "")


def test_a_thumbnail_does_not_hide_a_truncation(tmp_path, rgb):
    whole = with_segment(encoded(rgb), b"Exif\0\0" + encoded(rgb[::4, ::4]))
    assert read_bytes(tmp_path, whole).shape == rgb.shape
    with pytest.raises(ImageError, match="truncated"):
        read_bytes(tmp_path, whole[:-200])
    with pytest.raises(ImageError, match="not a picture, damaged"):  # and ends as whole files do
        read_bytes(tmp_path, whole[: whole.index(b"\xff\xd9") + 2])


def test_what_follows_a_jpeg_does_not_matter(tmp_path, rgb):
    """Phones append films and depth maps, which may hold any bytes."""
    read_bytes(tmp_path, encoded(rgb) + b"film\xff\xda\x00\x04more")


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty"),
        (b"x" * 1000, "not a picture"),
        (b"\x00\x00\x00\x18ftypheic" + b"\x00" * 100, "HEIC pictures are not supported; convert it to JPEG"),
        (b"\xff\xd8", "truncated"),
    ],
)
def test_files_that_are_no_pictures(tmp_path, data, reason):
    with pytest.raises(ImageError, match=rf"picture: .*{reason}"):
        read_bytes(tmp_path, data)


def test_pictures_in_memory_are_like_those_in_files(tmp_path, rgb):
    data = oriented(encoded(rgb), 6)
    for exif in (True, False):
        np.testing.assert_array_equal(decode_image(data, exif), read_bytes(tmp_path, data, exif=exif))
    with pytest.raises(ImageError, match=r"^the picture: .*truncated"):
        decode_image(data[:-200])


def test_files_that_cannot_be_opened(tmp_path):
    with pytest.raises(ImageError, match=r"none\.jpg.*No such file"):
        read_image(tmp_path / "none.jpg")
    with pytest.raises(ImageError, match="null"):
        read_image(tmp_path / "a\0.jpg")
    with pytest.raises(ImageError, match="directory"):
        read_image(tmp_path)


def test_writing_needs_a_known_ending(tmp_path, rgb):
    with pytest.raises(InputError, match=r"\.jpg"):
        write_image(tmp_path / "a.xyz", rgb)
    write_image(tmp_path / "grey.PNG", rgb[..., 0])
    np.testing.assert_array_equal(read_image(tmp_path / "grey.PNG")[..., 1], rgb[..., 0])


@pytest.mark.parametrize(("suffix", "shape"), [(".jpg", (1, 65_501, 3)), (".webp", (20_000, 1))])
def test_pictures_too_large_for_their_format_are_refused(tmp_path, suffix, shape, capfd):
    with pytest.raises(ImageError, match=rf"a\{suffix}: .*{shape[1]} x {shape[0]} pixels is too large for \{suffix}"):
        write_image(tmp_path / f"a{suffix}", np.zeros(shape, np.uint8))
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr().err == ""


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_grey_is_luminance_whatever_the_layout(height, width, seed):
    rgb = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    grey = to_grey(rgb)
    assert grey.dtype == np.uint8
    np.testing.assert_allclose(grey, rgb @ [0.299, 0.587, 0.114], atol=0.51 + 1e-3)
    alpha = np.dstack([rgb, np.full((height, width), 9, np.uint8)])
    np.testing.assert_array_equal(to_grey(alpha), grey)
    np.testing.assert_array_equal(to_grey(rgb.astype(np.uint16) * 256 + 255), grey)
    np.testing.assert_array_equal(to_grey(grey), grey)
    np.testing.assert_array_equal(to_grey(grey[..., None]), grey)
    np.testing.assert_array_equal(to_grey(rgb[::-1, ::-1]), grey[::-1, ::-1])


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4), np.float32),
        np.zeros((4, 4), np.int64),
        np.zeros((4, 4), bool),
        np.zeros((4, 4, 2), np.uint8),
        np.zeros((4, 4, 5), np.uint8),
        np.zeros(4, np.uint8),
        np.zeros((2, 4, 4, 3), np.uint8),
        np.zeros((0, 4), np.uint8),
        np.zeros((4, 0, 3), np.uint8),
    ],
)
def test_other_arrays_are_no_pictures(image):
    with pytest.raises(ImageError, match=re.escape(f"got {image.dtype} {image.shape}")):
        to_grey(image)


def test_pictures_are_found_in_files_and_folders(tmp_path):
    folder = tmp_path / "folder"
    (folder / "deeper.jpg").mkdir(parents=True)
    for name in ("b.JPG", "a.png", "c.heic", "notes.txt", "._a.png"):
        (folder / name).touch()
    (tmp_path / "odd.name").touch()
    found = find_images([tmp_path / "odd.name", str(folder), folder / "a.png"])
    assert [path.name for path in found] == ["odd.name", "a.png", "b.JPG", "c.heic"]


def test_what_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no pictures in .*expected .*\.jpg"):
        find_images([tmp_path])
    with pytest.raises(InputError, match="no such file or folder"):
        find_images([tmp_path / "none.jpg"])


def test_remembered_pictures_are_those_in_the_files(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png"):
        write_image(tmp_path / name, rng.integers(0, 256, (20, 30, 3), np.uint8))
    remembered = GreyPictures(most_bytes=700.0)  # one of them
    for name in ("a.png", "b.png"):
        np.testing.assert_array_equal(remembered(tmp_path / name), read_grey(tmp_path / name))
        (tmp_path / name).unlink()
    assert remembered(tmp_path / "a.png").shape == (20, 30)
    with pytest.raises(ImageError, match=r"b\.png: cannot be read"):
        remembered(tmp_path / "b.png")
