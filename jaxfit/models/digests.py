"""Digests of pictures: they show what a model learned from, whatever a picture's file is called by then."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jaxfit.data.pictures import Read, to_grey
from jaxfit.errors import ImageError

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
