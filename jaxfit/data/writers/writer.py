"""What a writer of results is: faces in, files out."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from jaxfit.data.fitted import FittedFace
from jaxfit.shapes.schemes import Scheme


@dataclass(frozen=True)
class Results:
    """All faces that were fitted by one model.

    Attributes:
        faces: goes through them, in the order of their pictures, as often as it is called.
        scheme: what the landmarks mean.
        modes: coefficients of the 3D shape model; None for models without 3D.
        confident: whether the model has a confidence.
    """

    faces: Callable[[], Iterator[FittedFace]]
    scheme: Scheme
    modes: int | None
    confident: bool


class Writer(Protocol):
    """Writes results in one format. Each face is in memory once; files are written whole or not at all."""

    def __call__(self, folder: Path, results: Results) -> list[str]:
        """Write into a folder.

        Returns:
            The names of what was written there.
        """
        ...
