"""Pictures from and to files: whole, upright, 8-bit, or a clear reason why not."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from contextlib import contextmanager
from functools import partial
from glob import escape, glob
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import jax
import numpy as np

from jaxfit.data.damage import damage_of
from jaxfit.data.headers import (
    BEGINNING,
    END_OF_IMAGE,
    JPEG,
    PNG,
    is_heic,
    jpeg_head,
    jpeg_markers,
    looks_like_picture,
    stored_size,
)
from jaxfit.data.inputs import open_regular, read_regular
from jaxfit.data.limits import count_picture, most_picture_bytes, size_problem
from jaxfit.data.names import each_once
from jaxfit.data.orientations import SIDEWAYS, as_seen, as_stored, orientation_of
from jaxfit.data.outputs import atomic_write
from jaxfit.data.sizes import TIFF, cost_of, is_deep
from jaxfit.data.threads import interruptible
from jaxfit.errors import ImageError, InputError

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
# Taken up from folders as well, by their names; read_image says what is wrong with those that it cannot read. Files of
# other names are taken up if they begin like pictures.
READABLE_SUFFIXES = (
    *PICTURE_SUFFIXES,
    *(".jfif", ".jpe", ".gif", ".avif", ".jp2", ".pbm", ".pgm", ".ppm", ".pnm", ".heic", ".heif", ".hif", ".jxl"),
)
# In most of these OpenCV finds a thumbnail only.
_RAW_SUFFIXES = (".arw", ".cr2", ".cr3", ".dng", ".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2", ".srw")
_VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm", ".wmv")
# OpenCV has one log for all threads: the first to come silences it, the last to leave does not.
_QUIET, _inside, _level_before = Lock(), 0, 0

# What callers hand over may be anything: `to_eight_bits` and `several` say what is wrong with it.
Pixels = Any  # an array of NumPy or JAX, or a PIL image
Image = Any  # such pixels, a file, or the bytes in one
Images = Any  # a list of such, an array, a generator: what has an order
Read = Callable[[Any], Pixels]  # of a Path or bytes; bytes only where pictures come as such
NAMELESS = "the picture"  # what errors call one that came without a file
_PIL = Lock()  # its images read their files when they are first used, in one thread at a time
_ORIENTATION, _UPRIGHT = 0x0112, 1  # EXIF
_OF_CAMERAS = 14  # bits; pictures of 16 that use no more hold the numbers of a camera, or of 8 bits
_ROWS = 64  # of a picture that are converted at a time: they stay in the cache
_QUICK = 8_000_000  # pixels, times scans, and slow bytes that take under two seconds in any format


def read_image(path: str | Path | bytes, exif: bool = True) -> np.ndarray:
    """The picture in a file as RGB, uint8 (H, W, 3); transparency is dropped.

    Of 16 bits the upper 8 are kept; if no value uses more than 14 bits, the upper 8 of the largest value, so that
    pictures of 10, 12 or 14 bits are not dark. Of animations, and of files with several pictures, the first picture is
    read. HEIC pictures
    need the extra ``jaxfit[heif]``.

    Args:
        path: the file, or the bytes in it.
        exif: turn the picture upright as its EXIF orientation says, or that of TIFF and AVIF files, as everything in
            jaxfit does; False gives the pixels as they are stored.

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


def picture_size(path: str | Path) -> tuple[int, int]:
    """Width and height of a picture as it is seen, in pixels; of most formats, only the file's header is looked at.

    Raises:
        ImageError: it cannot be read.
    """
    data = _data(path)
    # The others' headers do not say how large they are seen: they may have tiles, or several pictures.
    size = stored_size(data) if data.startswith((JPEG, PNG)) else None
    if size is None:
        height, width = _decoded(path, data, cv2.IMREAD_GRAYSCALE, exif=True).shape[:2]
        return width, height
    width, height = size
    return (height, width) if orientation_of(data) in SIDEWAYS else (width, height)


def _name(path: str | Path | bytes) -> str | Path:
    return NAMELESS if isinstance(path, bytes) else path


def _data(path: str | Path | bytes) -> bytes:
    """What is in a file that may be a picture."""
    if isinstance(path, bytes):
        return path
    try:
        return read_regular(path, most_picture_bytes())
    except (OSError, ValueError) as error:  # ValueError: a null character, as damaged labels may have
        why = None
        if isinstance(error, IsADirectoryError):
            why = _listing_problem(path) or "it is a folder: jaxfit.data.find_images lists the pictures in it"
        raise ImageError(f"{path}: cannot be read ({why or getattr(error, 'strerror', None) or error})") from error


def _decoded(source: str | Path, data: bytes, flags: int, exif: bool) -> np.ndarray:
    """The picture in a file's data, RGB or grey; errors are those of `read_image`."""
    if complaint := _complaint(data):
        raise ImageError(f"{source}: {complaint}")
    head = jpeg_head(data) if data.startswith(JPEG) else None
    if head is None and Path(source).suffix.lower() in _RAW_SUFFIXES:
        raise ImageError(f"{source}: camera raw files are not supported; export it as JPEG")
    size, scans, weight, slow = cost_of(data, head)
    width, height = size or (0, 0)
    if complaint := size_problem(width, height, scans, weight, slow):
        raise ImageError(f"{source}: {complaint}")
    count_picture(round(width * height * weight))
    if is_heic(data):
        rgb = _from_heic(source, data)
        return to_grey(rgb) if flags == cv2.IMREAD_GRAYSCALE else rgb
    decode = partial(_by_opencv, source, data, long=width * height * scans + slow > _QUICK)
    # A file whose header gives no size could hold any number of pixels.
    picture = None if size is None else decode(flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is not None and head is None and is_deep(data) and picture.max() <= 1 << _OF_CAMERAS - 8:
        picture = None  # not held while it is read again
        deep = decode(flags | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
        picture = None if deep is None else _upper_bits(deep)
    if picture is None:
        raise ImageError(f"{source}: not a picture, damaged, or of a format that OpenCV does not read")
    if picture.ndim == 3:
        for first in range(0, len(picture), _ROWS):  # OpenCV copies what it converts in place
            rows = picture[first : first + _ROWS]
            cv2.cvtColor(rows, cv2.COLOR_BGR2RGB, rows)
    turned_by_opencv = data[:4] in TIFF  # whatever it is asked
    if exif == turned_by_opencv:
        return picture
    return (as_seen if exif else as_stored)(picture, orientation_of(data, head))


def _by_opencv(source: str | Path, data: bytes, flags: int, *, long: bool) -> np.ndarray | None:
    """What OpenCV makes of a picture, which may take long; None if it makes nothing of it.

    Raises:
        ImageError: it says that the picture is damaged.
    """
    decode = partial(cv2.imdecode, np.frombuffer(data, np.uint8), flags)
    try:
        with quiet():
            picture, damage = interruptible(partial(damage_of, decode)) if long else damage_of(decode)
    except cv2.error as error:
        raise ImageError(f"{source}: cannot be decoded ({error.err or error})") from error
    if damage:
        raise ImageError(f"{source}: damaged ({damage}); copy or download it again")
    return picture


def require_heif() -> None:
    """Check that HEIC pictures can be read.

    Raises:
        ImageError: pillow-heif is not installed.
    """
    if find_spec("pillow_heif") is None:
        raise ImageError(
            'HEIC pictures need pillow-heif, which is not installed: pip install "jaxfit[heif]", or convert it to JPEG'
        )


def _from_heic(source: str | Path, data: bytes) -> np.ndarray:
    """A HEIC picture, RGB and upright: how it is turned is a part of its coding, whatever its EXIF data say."""
    try:
        require_heif()
        import pillow_heif

        file = pillow_heif.open_heif(data, convert_hdr_to_8bit=True)
        picture = to_eight_bits(np.array(file))  # a copy: its pixels are gone with the file
    except ImageError as error:
        raise ImageError(f"{source}: {error}") from None
    except (EOFError, OSError, RuntimeError, SyntaxError, ValueError) as error:
        raise ImageError(f"{source}: cannot be decoded ({error})") from error
    return picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)


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


def write_image(path: str | Path, rgb: Pixels) -> None:
    """Write a picture as in `to_eight_bits`, with 8 bits, in the format that the name's suffix says, atomically.

    Raises:
        InputError: no format has this suffix, or the folder is missing.
        ImageError: it is no such picture, or too large for the format.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in PICTURE_SUFFIXES:
        raise InputError(f"cannot write {path}: expected a name ending in one of {' '.join(PICTURE_SUFFIXES)}")
    rgb = to_eight_bits(rgb)
    stored = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR) if rgb.ndim == 3 else rgb
    with quiet():
        done, encoded = cv2.imencode(suffix, stored)
    if not done:
        height, width = rgb.shape[:2]
        raise ImageError(f"cannot write {path}: a picture of {width} x {height} pixels is too large for {suffix}")
    with atomic_write(path) as file:
        file.write(encoded.tobytes())


def to_grey(image: Pixels) -> np.ndarray:
    """Luminance, uint8 (H, W), of a picture as in `to_eight_bits`.

    Raises:
        ImageError: as `to_eight_bits`.
    """
    image = to_eight_bits(image)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def to_eight_bits(image: Pixels) -> np.ndarray:
    """A picture as a contiguous uint8 array, (H, W) or (H, W, 3) RGB.

    It may be a uint8 or uint16 array of NumPy or JAX, (H, W), (H, W, 1), (H, W, 3) RGB or (H, W, 4) RGBA; or a PIL
    image of any mode that PIL makes RGB or grey of. Transparency is dropped. Of 16 bits the
    upper 8 are kept; where no value uses more than 14, those of the largest value, so that pictures of 8, 10, 12 or 14
    bits in 16 are not dark.

    Raises:
        ImageError: another kind of object; another type of number, another number of axes or channels, or no pixels; or
            a PIL image that is damaged, or is still to be turned as its EXIF data say.
    """
    image = _array(image)
    channels = 1 if image.ndim == 2 else image.shape[2] if image.ndim == 3 else 0
    deep = image.dtype.kind == "u" and image.dtype.itemsize == 2  # in either order of bytes
    if not (image.dtype == np.uint8 or deep) or channels not in (1, 3, 4) or not image.size:
        raise ImageError(
            "expected a uint8 or uint16 picture (H, W), (H, W, 1), (H, W, 3) RGB or (H, W, 4) RGBA with at least one "
            f"pixel; got {image.dtype} {image.shape}{_advice(image)}"
        )
    if channels == 1:
        image = image.reshape(image.shape[:2])
    elif channels == 4:
        image = image[..., :3]
    return np.ascontiguousarray(_upper_bits(image) if deep else image)


def _upper_bits(image: np.ndarray) -> np.ndarray:
    """A uint16 array as uint8: the upper 8 bits, of those that are used if they are so few that it would be dark."""
    used = int(image.max()).bit_length()
    left_out = 8 if used > _OF_CAMERAS else max(0, used - 8)
    eight = np.empty(image.shape, np.uint8)
    for first in range(0, len(image), _ROWS):  # what is computed with 16 bits is not held as a whole
        eight[first : first + _ROWS] = image[first : first + _ROWS] >> left_out
    return eight


def _array(image: Pixels) -> np.ndarray:
    if isinstance(image, np.ndarray):
        return np.asarray(image)
    if isinstance(image, jax.Array):
        try:
            return np.asarray(image)
        except (RuntimeError, TypeError, ValueError) as error:  # deleted or donated, of keys, elsewhere, being traced
            why = str(error).partition("\n")[0]
            raise ImageError(f"an array of JAX that cannot be used ({why}); give numpy.asarray(image)") from None
    if _is_of_pil(image):
        return _array_of_pil(image)
    advice = "make it a uint8 array (H, W, 3) first, as tensor.cpu().numpy() and numpy.asarray do"
    if isinstance(image, str | bytes | os.PathLike):
        advice = "read files with jaxfit.read_image"
    raise ImageError(f"expected an array of NumPy or JAX, or a PIL image; got {kind_of(image)}; {advice}")


def kind_of(thing: object) -> str:
    """What an object is, with the package that it comes from: ``torch.Tensor``."""
    package = type(thing).__module__.partition(".")[0]
    return type(thing).__qualname__ if package == "builtins" else f"{package}.{type(thing).__qualname__}"


def _is_of_pil(thing: object) -> bool:
    """Whether an object is one of PIL's, which need not be installed."""
    return any(of.__module__.partition(".")[0] == "PIL" for of in type(thing).__mro__)


def _array_of_pil(image: Any) -> np.ndarray:
    """The pixels of a PIL image: what its numbers mean is up to its mode, as with palettes and CMYK."""
    try:
        with _PIL:
            image.load()
        orientation = image.getexif().get(_ORIENTATION, _UPRIGHT)
        if image.mode.startswith("I;16"):  # which PIL would cut off at 255
            return np.asarray(image)
        if image.mode not in ("I", "F"):  # numbers of any range: refused as such arrays are
            # Transparent palettes become RGBA only; RGBA becomes RGB.
            image = image.convert("L" if image.mode in ("1", "L", "LA", "La") else "RGBA").convert("RGB")
        array = np.asarray(image)
    except (AttributeError, OSError, SyntaxError, TypeError, ValueError) as error:
        raise ImageError(f"a PIL image that cannot be used ({error})") from error
    if orientation in range(_UPRIGHT + 1, 9):
        raise ImageError(
            f"expected upright pixels; the PIL image's EXIF data say that they are still to be turned (orientation "
            f"{orientation}): give PIL.ImageOps.exif_transpose(image), or numpy.asarray(image.convert('RGB')) for its "
            "pixels as they are"
        )
    return array


def _advice(image: np.ndarray) -> str:
    """What to do about an array that is no picture, as far as it can be guessed; behind a semicolon."""
    if image.ndim == 3 and image.shape[0] in (1, 3, 4) and image.shape[2] not in (1, 3, 4):
        return "; channels come last: numpy.moveaxis(image, 0, -1)"
    if image.dtype.kind == "b":
        return "; give 255 * image.astype(numpy.uint8)"
    if image.dtype.kind in "iu":
        return "; give image.astype(numpy.uint8) if its values go from 0 to 255"
    if image.dtype.kind != "f" or not np.isfinite(image).all() or not image.size:
        return ""
    low, high = float(image.min()), float(image.max())
    within = f" with values from {low:.3g} to {high:.3g}, whose black and white are not known; give "
    if low >= 0 and high <= 1:
        return f"{within}(255 * image).round().astype(numpy.uint8) if white is 1"
    if low >= 0 and high <= 255:
        return f"{within}image.round().astype(numpy.uint8) if white is 255"
    return f"{within}uint8 values, from 0, black, to 255, white"


def find_images(paths: Iterable[str | Path], recursive: bool = False) -> list[Path]:
    """The files among ``paths`` and the pictures in the folders among them, folders sorted by name.

    In folders, pictures are recognised by their names or their first bytes. Files and inner folders that cannot be read
    are in the list too: `read_image` says what is wrong with them. A path that is given twice comes once. Hidden files
    and
    folders in folders are left out. A path that does not exist may be a pattern, such as ``photos/*.jpg`` or
    ``photos/**/*.jpg``; folders that it looks into and that cannot be read are in the list.

    Args:
        paths: files, folders and patterns.
        recursive: take pictures in folders within the folders, too.

    Raises:
        InputError: one path comes instead of a sequence, a path does not exist, nothing fits a pattern, a folder cannot
            be read or has no picture, or a file is a video.
    """
    if isinstance(paths, str | os.PathLike):
        raise InputError(f"expected a sequence of files, folders and patterns, got {str(paths)!r}; put it in a list")
    found: list[Path] = []
    for path in map(Path, paths):
        matches = [path] if os.path.exists(path) else sorted(map(Path, _matches(str(path))))
        closed = [] if matches == [path] else _closed_folders(path)
        if not matches and not closed:
            raise InputError(_absent(path))
        found += closed  # whose pictures the pattern may mean
        for match in matches:
            if match.is_dir() and (match == path or recursive):
                found += _pictures_in(match, recursive)
            elif match.is_file() and match.suffix.lower() in _VIDEO_SUFFIXES:
                raise InputError(f"{match} is a video: `jaxfit track` follows faces through videos")
            elif not match.is_dir():
                found.append(match)
    return each_once(found)


def _matches(pattern: str) -> set[str]:
    """What a pattern stands for; ``**`` goes through folders as deep as they are, and once round where links lead in
    circles."""
    before, deep, after = pattern.partition("**")
    if not deep or not (before.endswith(os.sep) or not before) or not (after.startswith(os.sep) or not after):
        return {*glob(pattern)}
    found: set[str] = set()
    for top in glob(before) if before else [os.curdir]:
        visited: set[str] = set()
        for place, folders, _ in os.walk(top, followlinks=True):
            if (real := os.path.realpath(place)) in visited:
                folders.clear()
                continue
            visited.add(real)
            folders[:] = [name for name in folders if not name.startswith(".")]
            found |= _matches(escape(place) + (after or f"{os.sep}*"))
    return found


def _closed_folders(pattern: Path) -> list[Path]:
    """The folders that a pattern looks into and that cannot be read."""
    looked_into = (folder for part in pattern.parents for folder in map(Path, _matches(str(part))))
    return sorted({folder for folder in looked_into if folder.is_dir() and _listing_problem(folder)})


def _absent(path: Path) -> str:
    """Why there is nothing under a name: folders around it may be closed to us."""
    try:
        path.lstat()
    except PermissionError as error:
        return f"{path}: cannot be read ({error.strerror}); expected a file or folder that you may read"
    except (OSError, ValueError):
        pass
    return f"no such file or folder: {path}"


def _pictures_in(folder: Path, recursive: bool) -> list[Path]:
    if why := _listing_problem(folder):
        raise InputError(f"{folder}: the folder cannot be read ({why}); expected one that you may read")
    pictures: list[Path] = []
    closed: list[Path] = []  # until their turn comes
    visited: set[str] = set()
    deeper = False
    for place, folders, files in os.walk(
        folder, onerror=lambda error: closed.append(Path(error.filename)), followlinks=True
    ):
        pictures += closed
        closed.clear()
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        deeper = deeper or bool(folders)
        if (real := os.path.realpath(place)) in visited:  # links may lead round in circles
            folders.clear()
            continue
        visited.add(real)
        if not recursive:
            folders.clear()
        pictures += (
            path for name in sorted(files) if not name.startswith(".") and _is_picture(path := Path(place, name))
        )
    pictures += closed
    if not pictures:
        hint = "; to look into the folders in it, give --recursive (recursive=True)" if deeper and not recursive else ""
        raise InputError(
            f"no pictures in {folder}; expected files ending in {' '.join(PICTURE_SUFFIXES)}, or others that begin as "
            f"such do{hint}"
        )
    return pictures


def _is_picture(path: Path) -> bool:
    """Whether a file of a folder is a picture, or should be one: its name says so, or how it begins."""
    # Whatever they are: links to nothing, devices and camera raw files are reported.
    if path.suffix.lower() in (*READABLE_SUFFIXES, *_RAW_SUFFIXES):
        return True
    if not os.path.isfile(path):  # a look at a pipe would take what is in it, or wait for ever
        return False
    try:
        with open_regular(path) as file:
            return looks_like_picture(file.read(BEGINNING))
    except OSError:
        return False


def _listing_problem(folder: str | Path) -> str | None:
    """Why the files of a folder cannot be listed; None if they can."""
    try:
        os.scandir(folder).close()
    except OSError as error:
        return error.strerror or str(error)
    return None


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
    if (data.startswith(JPEG) and not _has_end(data)) or (data.startswith(PNG) and b"IEND" not in data):
        return "the file is truncated; copy or download it again"
    return None


def _has_end(jpeg: bytes) -> bool:
    """Whether a JPEG file has its picture's own end marker; those of embedded thumbnails and appended files do not
    count."""
    # Most files end with it; a search takes a tenth as long as decoding. Those torn right behind a thumbnail end so,
    # too, but have no picture to decode.
    return jpeg.endswith(bytes([0xFF, END_OF_IMAGE])) or any(marker == END_OF_IMAGE for marker, _ in jpeg_markers(jpeg))


def several(images: Images) -> list[Image]:
    """Pictures as a list: what comes from a generator is kept, and paths of any type are files.

    Raises:
        InputError: it is one picture, nothing that pictures come in one after another, or being traced by JAX.
    """
    require_several(images)
    try:
        listed = [
            Path(image) if isinstance(image, os.PathLike) else bytes(image) if isinstance(image, bytearray) else image
            for image in images
        ]
    except RuntimeError as error:  # an array of JAX that was deleted; generators of the caller's raise what they raise
        if not isinstance(images, jax.Array):
            raise
        raise InputError(f"expected a sequence of images; got an array of JAX that cannot be used ({error})") from None
    if any(isinstance(image, jax.core.Tracer) for image in listed):
        raise InputError(
            "expected pictures; got arrays that JAX is tracing, whose values are not known: call this outside of "
            "functions that jax.jit, jax.vmap or jax.grad transform; jaxfit.cascade.fit_crops can be traced"
        )
    return listed


def require_several(images: Images) -> None:
    """Check that pictures are several of them, in an order.

    Raises:
        InputError: as `several`.
    """
    if isinstance(images, np.ndarray | jax.Array):
        if images.ndim in (0, 2) or (images.ndim == 3 and images.shape[-1] in (3, 4)):
            raise InputError(f"expected a sequence of images, got one array {images.shape}; put it in a list")
        return
    if isinstance(images, str | os.PathLike):
        raise InputError(f"expected a sequence of images, got {str(images)!r}; put it in a list")
    if isinstance(images, bytes | bytearray):
        raise InputError(f"expected a sequence of images, got {len(images)} bytes; put them in a list")
    if _is_of_pil(images):
        raise InputError(f"expected a sequence of images, got {kind_of(images)}; put it, or its frames, in a list")
    table = len(getattr(images, "shape", (0,))) != 1  # a tensor's parts, or a data frame's columns, are no pictures
    if table or not isinstance(images, Iterable) or isinstance(images, Mapping | Set):
        raise InputError(
            f"expected a sequence of images: a list, a generator or an array of NumPy or JAX; got {kind_of(images)}"
        )


def pixels(image: Image, read: Read) -> Pixels:
    """The pixels of a picture, read if it is a file or the bytes of one."""
    if isinstance(image, bytes):
        return read(image)
    return read(Path(image)) if isinstance(image, str | Path) else image
