"""Pictures from and to files: whole, upright, 8-bit, or a clear reason why not."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from glob import glob
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np

from jaxfit.data.headers import END_OF_IMAGE, JPEG, PNG, jpeg_markers
from jaxfit.data.outputs import atomic_write
from jaxfit.errors import ImageError, InputError

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
# Taken up from folders all the same, so that read_image says what is wrong with them.
_UNREADABLE_SUFFIXES = (".heic", ".heif")
_VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm", ".wmv")
# OpenCV has one log for all threads: the first to come silences it, the last to leave does not.
_QUIET, _inside, _level_before = Lock(), 0, 0

Image = np.ndarray | str | Path | bytes  # pixels, a file, or the bytes in one
Images = Sequence[Image] | np.ndarray
Read = Callable[[Any], np.ndarray]  # of a Path or bytes; bytes only where pictures come as such
NAMELESS = "the picture"  # what errors call one that came without a file
_HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1")


def read_image(path: str | Path | bytes, exif: bool = True) -> np.ndarray:
    """The picture in a file as RGB, uint8 (H, W, 3); transparency is dropped and 16 bits become 8.

    Args:
        path: the file, or the bytes in it.
        exif: turn the picture upright as its EXIF orientation says, as everything in jaxfit does; False gives the
            pixels as they are stored.

    Raises:
        ImageError: the file is missing, empty, truncated, or not a picture that OpenCV reads.
    """
    return decode_image(_data(path), exif, _name(path))


def decode_image(data: bytes, exif: bool = True, source: str | Path = NAMELESS) -> np.ndarray:
    """The picture in what a file holds as RGB, uint8 (H, W, 3), as `read_image` reads it.

    Args:
        data: the bytes of the file.
        exif: as in `read_image`.
        source: what errors call the picture.

    Raises:
        ImageError: the data are empty, truncated, or not a picture that OpenCV reads.
    """
    return _decoded(source, data, cv2.IMREAD_COLOR, exif)


def read_grey(path: str | Path | bytes) -> np.ndarray:
    """The picture in a file, or in the bytes of one, turned upright as its EXIF data say, grey, uint8 (H, W).

    Raises:
        ImageError: as `read_image`.
    """
    data, name = _data(path), _name(path)
    if data.startswith(JPEG):  # which stores luminance: colours need not be decoded, which takes as long again
        return _decoded(name, data, cv2.IMREAD_GRAYSCALE, exif=True)
    return to_grey(_decoded(name, data, cv2.IMREAD_COLOR, exif=True))


def _name(path: str | Path | bytes) -> str | Path:
    return NAMELESS if isinstance(path, bytes) else path


def _data(path: str | Path | bytes) -> bytes:
    """What is in a file that may be a picture."""
    if isinstance(path, bytes):
        return path
    try:
        with open(path, "rb", buffering=0) as file:  # each call less is a wait less for Python's lock
            return file.read()
    except (OSError, ValueError) as error:  # ValueError: a null character, as damaged labels may have
        raise ImageError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error


def _decoded(source: str | Path, data: bytes, flags: int, exif: bool) -> np.ndarray:
    """The picture in a file's data, RGB or grey; errors are those of `read_image`."""
    if complaint := _complaint(data):
        raise ImageError(f"{source}: {complaint}")
    flags = flags if exif else flags | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        with quiet():
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f"{source}: cannot be decoded ({error.err or error})") from error
    if picture is None:
        raise ImageError(f"{source}: not a picture, damaged, or of a format that OpenCV does not read")
    return picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


class GreyPictures:
    """`read_grey` with a memory, for work that reads the same pictures again and again.

    Args:
        most_bytes: how much is kept; what comes after that is read each time.
    """

    def __init__(self, most_bytes: float = 4e9):
        self._left = most_bytes
        self._lock = Lock()
        self._kept: dict[Path, np.ndarray] = {}

    def __call__(self, path: str | Path) -> np.ndarray:
        """The picture, uint8 (H, W).

        Raises:
            ImageError: as `read_image`.
        """
        path = Path(path)
        if path not in self._kept:
            grey = read_grey(path)
            with self._lock:  # threads read at the same time
                if path not in self._kept:
                    if grey.nbytes > self._left:
                        return grey
                    self._left -= grey.nbytes
                    self._kept[path] = grey
        return self._kept[path]


def write_image(path: str | Path, rgb: np.ndarray) -> None:
    """Write a picture, uint8 (H, W, 3) RGB or (H, W) grey, in the format that the name's suffix says, atomically.

    Raises:
        InputError: no format has this suffix, or the folder is missing.
        ImageError: the picture is too large for the format.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in PICTURE_SUFFIXES:
        raise InputError(f"cannot write {path}: expected a name ending in one of {' '.join(PICTURE_SUFFIXES)}")
    stored = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR) if rgb.ndim == 3 else rgb
    with quiet():
        done, encoded = cv2.imencode(suffix, stored)
    if not done:
        height, width = rgb.shape[:2]
        raise ImageError(f"cannot write {path}: a picture of {width} x {height} pixels is too large for {suffix}")
    with atomic_write(path) as file:
        file.write(encoded.tobytes())


def to_grey(image: np.ndarray) -> np.ndarray:
    """Luminance, uint8 (H, W), of a picture as in `to_eight_bits`.

    Raises:
        ImageError: as `to_eight_bits`.
    """
    image = to_eight_bits(image)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def to_eight_bits(image: np.ndarray) -> np.ndarray:
    """A uint8 or uint16 picture (H, W), (H, W, 1), (H, W, 3) RGB or (H, W, 4) RGBA as uint8, (H, W) or (H, W, 3).

    Transparency is dropped, of 16 bits the upper 8 are kept.

    Raises:
        ImageError: another type of number, another number of axes or channels, or no pixels.
    """
    image = np.asarray(image)  # None, as from a failed cv2.imread, is refused below like any other object
    channels = 1 if image.ndim == 2 else image.shape[2] if image.ndim == 3 else 0
    if image.dtype not in (np.uint8, np.uint16) or channels not in (1, 3, 4) or not image.size:
        raise ImageError(
            "expected a uint8 or uint16 picture (H, W), (H, W, 1), (H, W, 3) RGB or (H, W, 4) RGBA with at least one "
            f"pixel; got {image.dtype} {image.shape}"
        )
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if channels == 1:
        return np.ascontiguousarray(image.reshape(image.shape[:2]))
    return np.ascontiguousarray(image[..., :3])


def find_images(paths: Iterable[str | Path], recursive: bool = False) -> list[Path]:
    """The files among ``paths`` and the pictures in the folders among them, folders sorted by name.

    What is named twice comes once. Hidden files and folders in folders are left out. A path that does not exist may be
    a pattern, such as ``photos/*.jpg`` or ``photos/**/*.jpg``.

    Args:
        paths: files, folders and patterns.
        recursive: take pictures in folders within the folders, too.

    Raises:
        InputError: a path does not exist, nothing fits a pattern, a folder has no picture, or a file is a video.
    """
    found: list[Path] = []
    for path in map(Path, paths):
        matches = [path] if path.exists() else sorted(map(Path, glob(str(path), recursive=True)))
        if not matches:
            raise InputError(f"no such file or folder: {path}")
        for match in matches:
            if match.is_dir() and (match == path or recursive):
                found += _pictures_in(match, recursive)
            elif match.is_file() and match.suffix.lower() in _VIDEO_SUFFIXES:
                raise InputError(f"{match} is a video: `jaxfit track` follows faces through videos")
            elif not match.is_dir():
                found.append(match)
    return list(dict.fromkeys(found))


def _pictures_in(folder: Path, recursive: bool) -> list[Path]:
    wanted = (*PICTURE_SUFFIXES, *_UNREADABLE_SUFFIXES)
    pictures: list[Path] = []
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if recursive and not name.startswith("."))
        pictures += (
            path
            for name in sorted(files)
            if name.lower().endswith(wanted)
            and not name.startswith(".")
            and ((path := Path(place, name)).is_file() or path.is_symlink())  # links to nothing are reported
        )
    if not pictures:
        raise InputError(f"no pictures in {folder}; expected files ending in {' '.join(PICTURE_SUFFIXES)}")
    return pictures


@contextmanager
def quiet() -> Iterator[None]:
    """Failures are reported once, with the file's name; OpenCV would print its own account."""
    global _inside, _level_before
    log = cv2.utils.logging
    with _QUIET:
        if not _inside:
            _level_before = log.getLogLevel()
            log.setLogLevel(log.LOG_LEVEL_SILENT)
        _inside += 1
    try:
        yield
    finally:
        with _QUIET:
            _inside -= 1
            if not _inside:
                log.setLogLevel(_level_before)


def _complaint(data: bytes) -> str | None:
    """Why not to decode ``data``; OpenCV's own answer is often silence and a picture that is grey from some row on."""
    if not data:
        return "the file is empty"
    if data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS:
        return "HEIC pictures are not supported; convert it to JPEG"
    if (data.startswith(JPEG) and not _has_end(data)) or (data.startswith(PNG) and b"IEND" not in data):
        return "the file is truncated; copy or download it again"
    return None


def _has_end(jpeg: bytes) -> bool:
    """Whether a JPEG file has its picture's own end marker; those of embedded thumbnails and appended files do not
    count."""
    # Most files end with it; a search takes a tenth as long as decoding. Those torn right behind a thumbnail end so,
    # too, but have no picture to decode.
    return jpeg.endswith(bytes([0xFF, END_OF_IMAGE])) or any(marker == END_OF_IMAGE for marker, _ in jpeg_markers(jpeg))


def require_several(images: Images) -> None:
    """Check that pictures are a sequence of them.

    Raises:
        InputError: it is one picture.
    """
    if isinstance(images, np.ndarray) and (images.ndim == 2 or (images.shape[-1] in (3, 4) and images.ndim == 3)):
        raise InputError(f"expected a sequence of images, got one array {images.shape}; put it in a list")
    if isinstance(images, str | Path):
        raise InputError(f"expected a sequence of images, got {str(images)!r}; put it in a list")
    if isinstance(images, bytes):
        raise InputError(f"expected a sequence of images, got {len(images)} bytes; put them in a list")


def pixels(image: Image, read: Read) -> np.ndarray:
    """The pixels of a picture, read if it is a file or the bytes of one."""
    if isinstance(image, bytes):
        return read(image)
    return read(Path(image)) if isinstance(image, str | Path) else image
