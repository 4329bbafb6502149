"""Pictures from files: every kind that cameras and editors write, and every way to be broken."""

import errno
import io
import os
import re
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from exif_files import TURNS, oriented, with_segment
from hypothesis import given
from hypothesis import strategies as st
from jax import numpy as jnp

from jaxfit.data import pictures
from jaxfit.data.headers import stored_size
from jaxfit.data.orientations import orientation_of
from jaxfit.data.pictures import (
    GreyPictures,
    decode_image,
    find_images,
    picture_size,
    read_grey,
    read_image,
    several,
    to_eight_bits,
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
    assert orientation_of(oriented(plain, orientation)) == orientation
    (tmp_path / "sized.jpg").write_bytes(oriented(plain, orientation))
    assert picture_size(tmp_path / "sized.jpg") == turn(stored).shape[1::-1]


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


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".bmp", ".tif"])
def test_sizes_are_those_of_what_is_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(cv2.imencode(suffix, np.zeros((7, 12, 3), np.uint8))[1].tobytes())
    assert picture_size(path) == (12, 7)
    (tmp_path / "b.tif").write_bytes(b"II*\0")
    with pytest.raises(ImageError, match=r"b\.tif"):
        picture_size(tmp_path / "b.tif")


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
        (b"\xff\xd8", "truncated"),
    ],
)
def test_files_that_are_no_pictures(tmp_path, data, reason):
    with pytest.raises(ImageError, match=rf"picture: .*{reason}"):
        read_bytes(tmp_path, data)


def test_heic_is_read_or_says_what_reads_it(tmp_path, rgb, monkeypatch):
    data = b"\x00\x00\x00\x18ftypheic" + b"\x00" * 100
    with monkeypatch.context() as patch:
        patch.setattr(pictures, "find_spec", lambda name: None)
        with pytest.raises(ImageError, match=r'picture: HEIC .*pip install "jaxfit\[heif\]", or convert it to JPEG'):
            read_bytes(tmp_path, data)
    pil, heif = pytest.importorskip("PIL.Image"), pytest.importorskip("pillow_heif")
    file = io.BytesIO()
    heif.from_pillow(pil.fromarray(rgb)).save(file, quality=95)
    for read in (read_image, lambda path: np.dstack([read_grey(path)] * 3)):
        (tmp_path / "a.heic").write_bytes(file.getvalue())
        seen = read(tmp_path / "a.heic").astype(int)
        assert np.abs(seen - (rgb if read is read_image else to_grey(rgb)[..., None])).mean() < 4
    assert decode_image(file.getvalue()).flags.owndata  # the reader's memory is gone with the file
    assert stored_size(file.getvalue()) == (64, 64)  # which codes 64 x 48
    for wrong in (data, file.getvalue()[:-100]):
        with pytest.raises(ImageError, match="picture: cannot be decoded"):
            read_bytes(tmp_path, wrong)


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
    with pytest.raises(ImageError, match=r"it is a folder: jaxfit\.data\.find_images"):
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
    rgb.flat[0] = 255  # or 16 bits would be taken for those of a camera
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


@pytest.mark.parametrize(
    ("image", "advice"),
    [
        (np.linspace(0, 1, 48).reshape(4, 4, 3), "from 0 to 1, .*(255 * image).round().astype(numpy.uint8)"),
        (np.linspace(0, 254, 48, dtype=np.float32).reshape(4, 4, 3), "give image.round().astype(numpy.uint8)"),
        (np.linspace(-1, 1, 16).reshape(4, 4), "from -1 to 1, .*give uint8 values"),
        (np.full((4, 4), np.nan), "got float64 (4, 4)"),
        (np.zeros((4, 4), np.int64), "image.astype(numpy.uint8)"),
        (np.zeros((4, 4), bool), "255 * image.astype(numpy.uint8)"),
        (np.zeros((3, 40, 50), np.uint8), "numpy.moveaxis(image, 0, -1)"),
        (None, "got NoneType"),
        ([[1, 2], [3, 4]], "got list"),
        ("a.jpg", "got str; read files with jaxfit.read_image"),
        (Path("a.jpg"), "read files with jaxfit.read_image"),
        (type("Tensor", (), {"__module__": "torch"})(), "got torch.Tensor; .*tensor.cpu().numpy()"),
    ],
)
def test_the_refusal_of_what_is_no_picture_says_what_to_do(image, advice):
    with pytest.raises(ImageError, match=re.escape(advice).replace(re.escape(".*"), ".*")):
        to_eight_bits(image)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_sixteen_bits_are_not_dark_where_fewer_are_used(rgb, bits):
    rgb[0, 0] = 255
    deep = (rgb.astype(np.uint16) << 8 | rgb) >> (16 - bits)
    np.testing.assert_array_equal(to_eight_bits(deep), rgb)
    np.testing.assert_array_equal(to_eight_bits(deep[..., 0]), rgb[..., 0])
    transparent = np.dstack([deep, np.full(rgb.shape[:2], 65535, np.uint16)])
    np.testing.assert_array_equal(to_eight_bits(transparent), rgb)
    files = {suffix: cv2.imencode(suffix, deep[..., ::-1])[1].tobytes() for suffix in (".png", ".tif", ".jp2")}
    files["transparent.png"] = cv2.imencode(".png", transparent[..., [2, 1, 0, 3]])[1].tobytes()
    files["of its bits.ppm"] = b"P6\n64 48 %d\n" % max(256, 2**bits - 1) + deep.astype(">u2").tobytes()
    for name, data in files.items():
        away = np.abs(decode_image(data).astype(int) - rgb)
        assert away.max() <= (0 if name.endswith(("png", "ppm")) else 1), name  # others round


@pytest.mark.parametrize(
    ("form", "options"),
    [
        ("GIF", {}),
        ("PNG", {}),
        ("PNG", {"default_image": True}),
        ("WEBP", {"lossless": True}),
        ("AVIF", {"quality": 100}),
        ("TIFF", {}),
    ],
)
def test_the_first_of_several_pictures_in_a_file_is_read(form, options):
    pil = pytest.importorskip("PIL.Image")
    colours = [(200, 30, 30), (30, 200, 30), (30, 30, 200)]
    first, *others = [pil.fromarray(np.full((24, 32, 3), colour, np.uint8)) for colour in colours]
    file = io.BytesIO()
    first.save(file, form, save_all=True, append_images=others, duration=100, **options)
    # In some PNG files a picture stands before the animation, for programs that show none: browsers do not show it.
    shown = colours["default_image" in options]
    assert np.abs(decode_image(file.getvalue()).astype(int) - shown).max() <= 4


def test_arrays_of_jax_that_cannot_be_used_are_refused(rgb):
    deleted = jnp.asarray(rgb)
    deleted.delete()
    for image in (deleted, jax.random.key(0), jnp.zeros((4, 4), jnp.bfloat16)):
        with pytest.raises(ImageError, match=r"array of JAX that cannot be used|got bfloat16"):
            to_eight_bits(image)
    stack = jnp.asarray(rgb[None])
    stack.delete()
    with pytest.raises(InputError, match="an array of JAX that cannot be used"):
        several(stack)
    for traced in (lambda images: several(list(images)), several):
        with pytest.raises(InputError, match="JAX is tracing"):
            jax.eval_shape(traced, jnp.zeros((2, 4, 4, 3), jnp.uint8))


@given(st.integers(1, 9), st.integers(1, 9))
def test_arrays_of_any_layout_are_taken(height, width):
    rgb = np.random.default_rng(height * 10 + width).integers(0, 256, (height, width, 3), np.uint8)
    deep = rgb.astype(np.uint16) * 257
    deep.flat[0], rgb.flat[0] = 65535, 255
    for same in (np.asfortranarray(rgb), rgb[::-1][::-1], deep, deep.astype(">u2"), jnp.asarray(rgb)):
        picture = to_eight_bits(same)
        np.testing.assert_array_equal(picture, rgb)
        assert picture.flags.c_contiguous


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA", "1", "P", "PA", "CMYK", "YCbCr", "HSV", "I;16"])
def test_images_of_pil_are_seen_as_pil_shows_them(rgb, mode):
    pil = pytest.importorskip("PIL.Image")
    if mode == "I;16":
        deep = rgb[..., 0].astype(np.uint16) * 257
        np.testing.assert_array_equal(to_eight_bits(pil.fromarray(deep)), rgb[..., 0])
        return
    image = pil.fromarray(rgb)
    image = image.convert("P").convert("PA") if mode == "PA" else image.convert(mode)
    expected = np.asarray(image.convert("RGBA").convert("RGB") if "P" in mode else image.convert("RGB"))
    seen = to_eight_bits(image)
    np.testing.assert_array_equal(seen if seen.ndim == 3 else np.dstack([seen] * 3), expected)
    if mode in ("RGB", "RGBA", "CMYK"):
        np.testing.assert_array_equal(seen, rgb)


def test_images_of_pil_that_would_be_seen_wrong_are_refused(tmp_path, rgb):
    pil, ops = pytest.importorskip("PIL.Image"), pytest.importorskip("PIL.ImageOps")
    (tmp_path / "turned.jpg").write_bytes(oriented(encoded(rgb), 6))
    turned, torn = (pil.open(io.BytesIO(data)) for data in (oriented(encoded(rgb), 6), encoded(rgb)[:-200]))
    with pytest.raises(ImageError, match=r"orientation 6.*exif_transpose"):
        to_eight_bits(turned)
    away = to_eight_bits(ops.exif_transpose(turned)).astype(int) - read_image(tmp_path / "turned.jpg")
    assert np.abs(away).max() <= 8  # two decoders
    for image in (torn, pil.new("F", (4, 4)), pil.new("I", (4, 4)), pil.new("RGB", (0, 4))):
        with pytest.raises(ImageError):
            to_eight_bits(image)


def test_pictures_come_in_anything_that_has_an_order(rgb):
    tensor = type("Tensor", (), {"__module__": "torch", "shape": (2, 3, 4, 4), "__iter__": lambda self: iter([])})
    for images in ([rgb, rgb], (rgb, rgb), iter([rgb, rgb]), (rgb for _ in range(2)), np.stack([rgb, rgb])):
        assert [image.shape for image in several(images)] == [rgb.shape] * 2
    assert several(map(str, [1])) == ["1"]
    assert several([Path("a"), bytearray(b"b")]) == [Path("a"), b"b"]
    arrays = (rgb, jnp.asarray(rgb), np.array(5), jnp.array(5))
    for wrong in ({"a.jpg": rgb}, {"a.jpg"}, 5, None, tensor(), *arrays, "a.jpg", Path("a.jpg"), b"a"):
        with pytest.raises(InputError, match="expected a sequence of images"):
            several(wrong)
    with pytest.raises(InputError, match=r"got torch\.Tensor"):
        several(tensor())


def test_only_pictures_are_written(tmp_path, rgb):
    with pytest.raises(ImageError, match="white is 1"):
        write_image(tmp_path / "a.png", rgb / 255)
    assert not list(tmp_path.iterdir())


def test_pictures_are_found_in_files_and_folders(tmp_path):
    folder = tmp_path / "folder"
    (folder / "deeper.jpg").mkdir(parents=True)
    for name in ("b.JPG", "a.png", "c.heic", "notes.txt", "._a.png"):
        (folder / name).touch()
    (tmp_path / "odd.name").touch()
    found = find_images([tmp_path / "odd.name", str(folder), folder / "a.png"])
    assert [path.name for path in found] == ["odd.name", "a.png", "b.JPG", "c.heic"]


def test_a_picture_under_several_paths_is_found_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for name in ("a.png", "b.png"):
        (tmp_path / "photos" / name).touch()
    (tmp_path / "photos" / "c.png").symlink_to("a.png")  # has a name of its own, which results and boxes have
    (tmp_path / "link").symlink_to("photos")
    names = ["photos/b.png", str(tmp_path / "photos" / "b.png"), "./photos", "link", "link/../photos/a.png"]
    assert list(map(str, find_images(names))) == ["photos/b.png", "photos/a.png", "photos/c.png"]


def test_what_looks_like_a_picture_is_found_whatever_its_name(tmp_path, rgb):
    kinds = (".jpg", ".png", ".bmp", ".tif", ".webp", ".gif", ".avif", ".jp2", ".ppm")
    names = {f"{kind[1:]}{ending}" for kind in kinds for ending in ("", ".part", kind)}
    for name in names:
        (tmp_path / name).write_bytes(encoded(rgb, f".{name.split('.')[0]}"))
    (tmp_path / "a.jfif").write_bytes(encoded(rgb))
    begun = {
        "raw.dng": b"II*\0",
        "raw.cr3": b"\0\0\0\x18ftypcrx ",
        "big": b"II+\0\x08\0",
        "map": b"P7\nWIDTH 3\n",
        "floats": b"PF\n3 3\n",
        "new": b"\0\0\0\x0cJXL \r\n",
        "phone": b"\0\0\0\x18ftypmif1\0\0\0\0heic",
        "torn": b"\xff\xd8\xff",
    }
    others = {
        "a.csv": b"BMI,1",
        "b.txt": b"P5 is a letter and a digit",
        "c.mp4": b"\0\0\0\x18ftypisom",
        "d": b"",
        "e.pts": b"version: 1",
    }
    for name, data in (begun | others).items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "gone.gif").symlink_to(tmp_path / "nothing")
    os.mkfifo(tmp_path / "pipe.jpg")
    reported = ("gone.gif", "pipe.jpg")  # whatever they are, their names are those of pictures
    found = find_images([tmp_path])
    assert {path.name for path in found} == {*names, "a.jfif", *begun, *reported}
    for path in found:
        if path.name in {*begun, *reported}:
            with pytest.raises(ImageError, match=re.escape(path.name)):
                read_image(path)
        else:
            assert read_image(path).shape == rgb.shape


def test_folders_that_cannot_be_read_are_said(tmp_path, rgb, monkeypatch):
    for folder in ("open", "open/closed", "open/deep"):
        (tmp_path / folder).mkdir()
        write_image(tmp_path / folder / "a.png", rgb)
    (tmp_path / "open" / "link").symlink_to(tmp_path / "open")  # in a circle
    (tmp_path / "elsewhere").mkdir()
    write_image(tmp_path / "elsewhere" / "b.png", rgb)
    (tmp_path / "open" / "other").symlink_to(tmp_path / "elsewhere")
    scandir = os.scandir

    def closed(path):  # modes do not bind root
        if Path(path).name == "closed":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", closed)
    found = find_images([tmp_path / "open"], recursive=True)
    assert {str(path.relative_to(tmp_path / "open")) for path in found} == {
        "a.png",
        "closed",
        "deep/a.png",
        "other/b.png",
    }
    with pytest.raises(ImageError, match=r"closed: cannot be read \(Permission denied\)"):
        read_image(tmp_path / "open" / "closed")
    with pytest.raises(InputError, match=r"closed: the folder cannot be read \(Permission denied\)"):
        find_images([tmp_path / "open" / "closed"])
    for pattern in ("open/*/*.png", "open/**/*.png", "op*/cl*/*.png"):  # which would look into it
        assert tmp_path / "open" / "closed" in find_images([tmp_path / pattern]), pattern
    through_links = {path.resolve() for path in find_images([tmp_path / "open" / "**" / "*.png"])}
    assert through_links == {path.resolve() for path in find_images([tmp_path / "open"], recursive=True)}
    assert len(find_images([tmp_path / "open" / "**" / "**" / "a.png"])) < 9  # links that lead in circles
    assert find_images([tmp_path / "open" / "*.png"]) == [tmp_path / "open" / "a.png"]
    (tmp_path / "outer" / "inner").mkdir(parents=True)
    with pytest.raises(InputError, match=r"no pictures in .*--recursive"):
        find_images([tmp_path / "outer"])


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
