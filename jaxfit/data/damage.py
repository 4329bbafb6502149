"""What decoders say of damaged pictures: libjpeg goes on, fills what is lost with grey, and only prints a line."""

import atexit
import os
import re
import tempfile
from collections.abc import Callable
from threading import Condition
from typing import IO, TypeVar

T = TypeVar("T")

# Lines of libjpeg and libpng. Others, of bytes too many or of unknown versions, come with pictures that are whole.
_LINE = re.compile(
    rb"(?:Corrupt JPEG data|Premature end of JPEG|Inconsistent progression|Invalid SOS|Warning: unknown JFIF|"
    rb"Unknown Adobe color|libpng (?:warning|error))[^\n]*\n"
)
_DAMAGE = re.compile(rb"premature end|Premature end|bad Huffman|bad arithmetic|instead of RST|Inconsistent progression")


def _in_memory() -> IO[bytes]:
    """A file that is on no disk, where the system has such files."""
    if hasattr(os, "memfd_create"):
        import fcntl

        file = os.memfd_create("jaxfit")
        fcntl.fcntl(file, fcntl.F_SETFL, os.O_APPEND)  # else what two threads print at once lies over each other
        return os.fdopen(file, "w+b", buffering=0)
    return tempfile.TemporaryFile(buffering=0)


class _Listener:
    """Reads the standard error of the process while pictures are decoded, in however many threads.

    What others print there meanwhile is passed on; what processes print that are started meanwhile is lost.
    """

    def __init__(self) -> None:
        self._turn = Condition()
        self._inside = self._waiting = 0
        self._alone = False
        self._error: int | None = None  # where the standard error leads to
        self._file: IO[bytes] | None = None  # what is printed goes here instead; kept, as to make one takes long
        self._owner = 0  # the process that made it: one that was forked would share it
        self._passed = 0  # bytes of it that were looked at
        self._lines: list[str] = []  # of damage

    def __call__(self, decode: Callable[[], T]) -> tuple[T, str]:
        """What ``decode`` gives, and the first line that says that its picture is damaged; empty if none does.

        It is called once more, while no other picture is decoded, where it is not clear of whom a line speaks.
        """
        decoded, line = self._listen(decode, alone=False)
        return self._listen(decode, alone=True) if line else (decoded, line)

    def _listen(self, decode: Callable[[], T], alone: bool) -> tuple[T, str]:
        with self._turn:
            self._waiting += alone
            self._turn.wait_for(lambda: not self._alone and not (self._inside if alone else self._waiting))
            self._waiting -= alone
            if not self._inside:
                self._begin()
            self._inside += 1
            self._alone = alone
            before = len(self._lines)
        try:
            decoded = decode()
        finally:
            with self._turn:
                if self._inside == 1 and self._error is not None:
                    os.dup2(self._error, 2)  # first: what others print until then is passed on
                self._pass_on()
                lines = self._lines[before:]
                self._inside -= 1
                self._alone = self._alone and not alone
                if not self._inside:
                    self._close()
                self._turn.notify_all()
        return decoded, lines[0] if lines else ""

    def _begin(self) -> None:
        self._lines = []
        try:
            self._error = os.dup(2)
        except OSError:  # it is closed
            return
        try:
            if self._file is None or self._owner != os.getpid():
                self._file, self._owner, self._passed = _in_memory(), os.getpid(), 0
            os.dup2(self._file.fileno(), 2)
        except OSError:  # a full disk: the decoders' lines are seen on the terminal, and nowhere else
            self._close()

    def _pass_on(self) -> None:
        """Note what decoders have said, and print the rest."""
        if self._file is None or self._error is None:
            return
        at = os.fstat(self._file.fileno()).st_size
        if at == self._passed:
            return
        said = os.pread(self._file.fileno(), at - self._passed, self._passed)
        if self._inside > 1:  # others are still decoding, and may be in the middle of a line
            said = said[: said.rfind(b"\n") + 1]
        self._passed += len(said)
        self._lines += [
            line[0].decode(errors="replace").strip() for line in _LINE.finditer(said) if _DAMAGE.search(line[0])
        ]
        rest = _LINE.sub(b"", said)
        while rest:
            rest = rest[os.write(self._error, rest) :]

    def _close(self) -> None:
        if self._error is not None:
            os.close(self._error)
            self._error = None
        if self._passed:  # what was printed is not kept
            self.forget()

    def forget(self) -> None:
        """Close the file that is kept for the next pictures."""
        if self._file is not None:
            self._file.close()
            self._file, self._passed = None, 0


damage_of = _Listener()
atexit.register(damage_of.forget)
