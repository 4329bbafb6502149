"""What is given to a run: when it has changed since, and that it is never written over."""

import errno
import hashlib
import os
import stat
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import IO

from jaxfit.errors import InputError


def open_regular(path: str | Path, most_bytes: int | None = None) -> IO[bytes]:
    """A file to read from, if it is a regular one: a pipe would keep its reader waiting, a device has no end.

    Args:
        path: the file.
        most_bytes: how large it may be: one of terabytes takes no room on a disk where it is all zeros.

    Raises:
        OSError: it is no such file, or cannot be opened.
    """
    return open(path, "rb", buffering=0, opener=partial(_open_regular, most_bytes))


def _open_regular(most_bytes: int | None, name: str | Path, flags: int) -> int:
    """The descriptor of a regular file."""
    try:
        descriptor = os.open(name, flags | getattr(os, "O_NONBLOCK", 0))
    except BlockingIOError:  # a file that another program wants to have written first: no pipe
        descriptor = os.open(name, flags)
    try:
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "a device or pipe, and not a regular file")
        if most_bytes is not None and found.st_size > most_bytes:
            raise OSError(errno.EFBIG, f"expected a file of at most {most_bytes:,} bytes; it has {found.st_size:,}")
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def read_regular(path: str | Path, most_bytes: int) -> bytes:
    """What is in a file, as `open_regular` opens it.

    Raises:
        OSError: as `open_regular`.
    """
    descriptor = _open_regular(most_bytes, path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0))
    parts = []
    try:  # a file object takes a fifth more time
        while part := os.read(descriptor, os.fstat(descriptor).st_size + 1):
            parts.append(part)
    finally:
        os.close(descriptor)
    return b"".join(parts)


def read_text(path: str | Path, most_bytes: int) -> str:
    """The text in a file in UTF-8, as `open_regular` opens it; line ends are as they are stored.

    Raises:
        OSError: as `open_regular`.
        UnicodeDecodeError: it is no UTF-8.
    """
    return read_regular(path, most_bytes).decode("utf-8-sig")


def state_of(files: Sequence[str | Path]) -> str:
    """A digest of the names, sizes and times of files: another one where one of them was replaced or changed."""
    digest = hashlib.sha256()
    for file in files:
        try:
            found = os.stat(file)
            state = f"{found.st_size} {found.st_mtime_ns}"
        except (OSError, ValueError):  # it is reported when it is read
            state = "none"
        digest.update(os.fsencode(file) + f"\0{state}\0".encode())
    return digest.hexdigest()[:32]


def require_no_inputs(outputs: Iterable[str | Path], inputs: Iterable[str | Path]) -> None:
    """Check that nothing that was given would be written over, under whatever name, links included.

    Args:
        outputs: files that may be written; they need not exist.
        inputs: files that were given.

    Raises:
        InputError: one is the other.
    """
    known = {identity: path for path in inputs for identity in (_identity(path), _identity(path, links=True))}
    known.pop(None, None)
    for path in outputs:
        if (given := known.get(_identity(path, links=True))) is not None:
            name = "" if str(given) == str(path) else f" as {given}"
            raise InputError(f"{path} was given as input{name}, and would be written over; use another --out")


def same_files(files: Iterable[Path], others: Iterable[Path]) -> dict[Path, None]:
    """Those of the files that are among others, under whatever name, in their order."""
    known = {_identity(path) for path in others} - {None}
    return dict.fromkeys(path for path in files if known and _identity(path) in known)


def _identity(path: str | Path, links: bool = False) -> tuple[int, int] | None:
    """Which file there is under a name, of a link the link itself if so wished; None if there is none."""
    try:
        found = os.lstat(path) if links else os.stat(path)
    except (OSError, ValueError):
        return None
    return found.st_dev, found.st_ino
