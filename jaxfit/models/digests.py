"""Digests of pictures: they show what a model learned from, whatever a picture's file is called by then."""

import hashlib
from collections.abc import Iterable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np

from jaxfit.data.inputs import open_regular
from jaxfit.data.limits import counted_together
from jaxfit.data.pictures import Read, read_grey, to_grey
from jaxfit.data.sizes import decoded_size
from jaxfit.data.threads import in_order, reading_threads
from jaxfit.errors import ImageError

_HEAD = 1 << 16  # bytes of a file that mostly say how large its picture is
_BYTES = 8  # that any two of a million pictures share a digest has a chance of 1 in 37 million

Digests = np.ndarray  # (N,) uint64, sorted, each once


def picture_digest(grey: np.ndarray) -> int:
    """The digest of a grey picture, uint8 (H, W): of its shape and pixels.

    Copies with the same grey pixels have the same. Others have another: what was shrunk, cut or stored as JPEG again,
    and a JPEG in colour stored as PNG, as its grey pixels are then computed from its colours.
    """
    digest = hashlib.blake2b(repr(grey.shape).encode(), digest_size=_BYTES)
    digest.update(np.ascontiguousarray(grey).data)
    return int.from_bytes(digest.digest(), "little")


def digest_set(digests: Iterable[int]) -> Digests:
    """Digests as models keep them."""
    return np.unique(np.array(list(digests), np.uint64))


def union(*parts: Digests | None) -> Digests | None:
    """The digests of what several trainings learned from; None, unknown, if one of them does not say."""
    known = [part for part in parts if part is not None]
    return np.unique(np.concatenate(known)) if known and len(known) == len(parts) else None


def same_pictures(tested: Iterable[Path], pictures: Iterable[Path]) -> dict[Path, Path]:
    """Which pictures have the digest of a tested one, whatever they are called, with what each is a copy of.

    Only pictures of the size of a tested one are decoded. What cannot be read is no copy.
    """
    by_size: dict[object, tuple[list[Path], list[Path]]] = {}
    for group, paths in enumerate((tested, pictures)):
        for path in dict.fromkeys(paths):
            by_size.setdefault(_header_size(path), ([], []))[group].append(path)
    compared = [groups for groups in by_size.values() if all(groups)]
    decoded = list(dict.fromkeys(path for groups in compared for group in groups for path in group))
    with closing(in_order((partial(_file_digest, path) for path in decoded), reading_threads(len(decoded)))) as found:
        digests = dict(zip(decoded, found, strict=True))
    known = {digests[path]: path for of_test, _ in compared for path in of_test}
    known.pop(None, None)
    return {path: known[digests[path]] for _, others in compared for path in others if digests[path] in known}


def _header_size(path: Path) -> object:
    """The sides of a picture, as far as its first bytes say, the shorter first, as it may be turned."""
    try:
        with open_regular(path) as file:
            return tuple(sorted(decoded_size(file.read(_HEAD)) or ()))
    except (OSError, ValueError):
        return ()


def _file_digest(path: Path) -> int | None:
    try:
        with counted_together():
            return picture_digest(read_grey(path))
    except (ImageError, OSError):
        return None


class DigestingReader:
    """Reads pictures as ``read`` does, and remembers their digests: no picture is decoded a second time for one.

    Args:
        read: gets a picture's path and returns it, uint8; it may be called in threads.
    """

    def __init__(self, read: Read):
        self._read = read
        self._digests: dict[Path, int] = {}

    def __call__(self, path: Path) -> np.ndarray:
        """The picture."""
        picture = self._read(path)
        self._digests[path] = picture_digest(to_grey(picture))
        return picture

    def among(self, paths: Iterable[Path], digests: Digests) -> np.ndarray:
        """(N,) bool, which pictures are among those with these digests; what was not read before is read now.

        Pictures that cannot be read are not: nothing was learned from them.
        """
        known = frozenset(digests.tolist())
        return np.array([self._digest(path) in known for path in paths], bool)

    def _digest(self, path: Path) -> int | None:
        if path not in self._digests:
            try:
                self(path)
            except (ImageError, OSError):
                return None
        return self._digests[path]
