"""Digests of pictures: what a model learned from can be told again, whatever a picture's file is called by then."""

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from jaxfit.data.pictures import to_grey
from jaxfit.errors import ImageError

_BYTES = 8  # of a million pictures, one in thirty million others would be taken for one of them

Digests = np.ndarray  # (N,) uint64, sorted, each once


def picture_digest(grey: np.ndarray) -> int:
    """The digest of a grey picture, uint8 (H, W): of its pixels and shape, and so of every lossless copy.

    A copy that was shrunk, cut or stored as JPEG again has other pixels, and another digest.
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


class DigestingReader:
    """Reads pictures as ``read`` does, and remembers their digests: no picture is decoded a second time for one.

    Args:
        read: gets a picture's path and returns it, uint8; it may be called in threads.
    """

    def __init__(self, read: Callable[[Path], np.ndarray]):
        self._read = read
        self._digests: dict[Path, int] = {}

    def __call__(self, path: Path) -> np.ndarray:
        """The picture."""
        picture = self._read(path)
        self._digests[path] = picture_digest(to_grey(picture))
        return picture

    def among(self, path: Path, digests: Digests) -> bool:
        """Whether a picture is one of those with these digests; it is read if it was not before."""
        if path not in self._digests:
            try:
                self(path)
            except (ImageError, OSError):
                return False  # what cannot be read was not learned from
        return bool(np.isin(np.uint64(self._digests[path]), digests))
