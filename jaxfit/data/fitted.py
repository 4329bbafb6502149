"""A fitted face as results are written of it, and the chunks that unfinished results wait in."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxfit.data.outputs import atomic_write

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class FittedFace:
    """A face in a picture; lengths in pixels of the picture, rounded as they are written.

    Attributes:
        image: the picture's file.
        face: what the face's own files are called.
        size: width and height of the picture.
        kind: what drew the box that the fit started from.
        box: its x, y, width and height.
        landmarks: L times x, y.
        confidence: the probability that the fit is good; None if the model does not tell.
        pose: roll, pitch and yaw in degrees; None, like all below, for models without 3D.
        scale: pixels of the picture per pixel of the canonical face.
        landmarks_3d: L times x, y and the depth.
        b: coefficients of the 3D shape model.
    """

    image: str
    face: str
    size: tuple[int, int]
    kind: str
    box: Numbers
    landmarks: Numbers
    confidence: float | None = None
    pose: Numbers | None = None
    scale: float | None = None
    landmarks_3d: Numbers | None = None
    b: Numbers | None = None


@dataclass(frozen=True)
class Problem:
    """Why a picture, or a face in it, has no fit.

    Attributes:
        image: the picture's file.
        why: a sentence.
    """

    image: str
    why: str


class Chunks:
    """What became of pictures, chunk by chunk, in a folder: a chunk is there as a whole or not at all.

    Args:
        folder: holds a file a chunk; it exists.
    """

    def __init__(self, folder: Path):
        self._folder = folder

    def _file(self, number: int) -> Path:
        return self._folder / f"{number:07}.jsonl"

    def has(self, number: int) -> bool:
        """Whether this chunk is there."""
        return self._file(number).exists()

    def put(self, number: int, faces: Sequence[FittedFace], problems: Sequence[Problem]) -> None:
        """Keep what became of a chunk of pictures."""
        with atomic_write(self._file(number), "w") as file:
            for entry in (*faces, *problems):
                file.write(json.dumps({key: value for key, value in vars(entry).items() if value is not None}) + "\n")

    def faces(self) -> Iterator[FittedFace]:
        """The faces of all chunks, in order."""
        for entry in self._entries():
            if "face" in entry:
                parts: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in entry.items()}
                yield FittedFace(**parts)

    def problems(self) -> Iterator[Problem]:
        """The problems of all chunks, in order."""
        for entry in self._entries():
            if "why" in entry:
                yield Problem(**entry)

    def _entries(self) -> Iterator[dict[str, Any]]:
        # Not what a killed run was writing: hidden files.
        for path in sorted(self._folder.glob("[0-9]*.jsonl")):
            with path.open(encoding="utf-8") as lines:
                for line in lines:
                    yield json.loads(line)
