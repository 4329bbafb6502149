"""One process at a time in a folder of results."""

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from jaxfit.data.outputs import sweep
from jaxfit.errors import InputError

try:
    import fcntl
except ImportError:  # not a POSIX system: nothing is held there
    fcntl = None  # type: ignore[assignment]

_LOCK = ".jaxfit-lock"
# Of file systems that have no locks, such as some of networks: there, nothing is held.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)


@contextmanager
def held(folder: str | Path, command: str) -> Iterator[None]:
    """Keep other processes that hold it, too, out of a folder of results, which is made if needed; what writing left
    there when a process was killed is removed.

    The system gives the folder back when a process ends, however it ends. Threads of one process are kept apart as
    well. Nothing is held on file systems, and on systems, without POSIX locks.

    Args:
        folder: of the results.
        command: whose, for the message.

    Raises:
        InputError: another process holds it, or nothing can be written there.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = _locked(folder)
    except OSError as error:
        raise InputError(f"expected a folder to write to; {folder}: {error.strerror}") from None
    try:
        os.truncate(lock, 0)
        account = f"`{command}`, process {os.getpid()} on {socket.gethostname()}, since {datetime.now():%Y-%m-%d %H:%M}"
        os.write(lock, account.encode())
        sweep(folder)
        yield
    finally:
        # While it is locked: whoever waits for this very file sees that it is no longer the folder's.
        try:
            with suppress(OSError):
                os.unlink(folder / _LOCK)
        finally:
            os.close(lock)


def _locked(folder: Path) -> int:
    """The open file that stands for the folder, locked.

    Raises:
        InputError: another process has locked it.
        OSError: it cannot be written.
    """
    path = folder / _LOCK
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(lock), os.stat(path)):
                return lock
            os.close(lock)
        except BlockingIOError:
            holder = os.read(lock, 1000).decode(errors="replace") or "another process"
            os.close(lock)
            raise InputError(
                f"{folder} is being written by {holder}; wait until it has ended, or use another --out"
            ) from None
        except FileNotFoundError:  # the one who held it has just removed it
            os.close(lock)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return lock
            os.close(lock)
            raise
