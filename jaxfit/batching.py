"""Fitting pictures batch by batch in workers of any kind: a process pool's, Ray's, Dask's or Spark's."""

import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from jaxfit.cascade.fit import ANY_ROTATION, check_rotations
from jaxfit.compiling import keep_compiled_code
from jaxfit.cropping import at_most_cores
from jaxfit.data.detectors import DEFAULT_DETECTOR, Detector, detector_named
from jaxfit.data.images import NAMELESS
from jaxfit.data.writers.tables import TEXTS, tables_of
from jaxfit.data.writers.writer import Results
from jaxfit.exceptions import InputError
from jaxfit.fitting import Fits, fit
from jaxfit.models.files import BUNDLED, DEFAULT_MODEL, load, read_named
from jaxfit.models.model import Model

_DIGITS = 3  # after the point, as `jaxfit fit` writes


@dataclass(frozen=True)
class BatchFitter:
    """Fits batches of pictures: columns in, columns out. It holds its settings only, so that it is small where it is
    sent to workers; each process loads the model when its first batch comes, once.

    Attributes:
        model: a bundled model's name, or a model file that every worker can read.
        detector: what finds the faces: its name, as in ``jaxfit.detect_faces``.
        initialisations: as in ``jaxfit.fit``, like the two below.
        rotations: in degrees.
        refine: for models of 3D alignment.
        cores: that a worker's threads keep busy; with a worker for each core, 1.

    Raises:
        InputError: no such detector, or a number out of range.
        ModelError: no such model.
    """

    model: str | Path = DEFAULT_MODEL
    detector: str = DEFAULT_DETECTOR
    initialisations: int = 1
    rotations: tuple[float, float] = ANY_ROTATION
    refine: bool = False
    cores: int = 1

    def __post_init__(self) -> None:
        # Not the model's contents: who sends this to workers need not have JAX take a device.
        read_named(self.model, BUNDLED, "model")
        detector_named(self.detector)
        check_rotations(self.initialisations, self.rotations)
        if self.cores < 1:
            raise InputError(f"expected at least one core for a worker; got {self.cores}")

    def __call__(self, batch: Any) -> dict[str, np.ndarray]:
        """Find and fit the faces in N pictures.

        Args:
            batch: columns by name, in a dict or a pandas data frame: ``image``, the pictures' files; or ``bytes``, what
                is in such files, and ``image``, what they are called. Ray's ``path`` is as good a name as ``image``.

        Returns:
            Columns of equal lengths, a row a face, in the order of the pictures, and a row for each picture without a
            face: those of `jaxfit fit`'s ``landmarks.parquet``, for 3D models those of ``heads.parquet`` with ``head_``
            before their names, and ``problem``, which is empty for faces that were fitted and says of all others why
            not. Words are objects, and empty where there is nothing to say; numbers are float32, and NaN.

        Raises:
            InputError: columns are missing, the model does not know the detector's boxes, or has nothing to refine.
            ModelError: the model file is damaged.
        """
        names, pictures = _pictures(batch)
        model, detector = _loaded(self.model, self.detector, self.cores)
        with at_most_cores(self.cores):
            fits = fit(
                model,
                pictures,
                detector=detector,
                initialisations=self.initialisations,
                rotations=self.rotations,
                refine=self.refine,
            )
        return _columns(model, fits, names, pictures)


def _pictures(batch: Any) -> tuple[list[str], list[Path | bytes]]:
    """What the pictures of a batch are called in tables, and their files or what is in those."""
    if not ("image" in batch or "path" in batch):
        raise InputError(f"expected a column of files, image or path; got {', '.join(map(str, batch)) or 'no column'}")
    given = [str(name) for name in batch["image" if "image" in batch else "path"]]
    names = list(map(plain, given))
    if "bytes" not in batch:
        return names, [Path(name) for name in given]
    return names, [b"" if data is None else bytes(data) for data in batch["bytes"]]


def plain(name: str) -> str:
    """The name of a file as it stands in tables, which take text only."""
    return name.encode("utf-8", "backslashreplace").decode()


@cache
def _loaded(model: str | Path, detector: str, cores: int) -> tuple[Model, Detector]:
    """What a process needs, once."""
    os.environ.setdefault("NPROC", str(cores))  # how many threads XLA starts, if it has not begun yet
    keep_compiled_code()
    return load(model), detector_named(detector)


def _columns(model: Model, fits: Fits, names: Sequence[str], pictures: Sequence[Path | bytes]) -> dict[str, np.ndarray]:
    """What `BatchFitter` returns."""
    modes = None if model.solid is None else len(model.solid.model.deviations)
    tables = tables_of(Results(lambda: iter(()), model.scheme, modes, model.confidence is not None))
    told = {
        "": _numbers(fits.boxes, fits.confidence, fits.landmarks),
        "head_": _numbers(fits.pose, fits.scale, fits.landmarks_3d, fits.b),
    }
    numbers = {
        f"{before}{name}": values
        for table, (before, columns) in zip(tables, told.items(), strict=False)  # there may be no heads
        for name, values in zip([name for name in table.columns if name not in TEXTS], columns, strict=True)
    }
    found = np.isfinite(fits.boxes).all(1)
    faces, problems, of_picture = [], [], Counter[int]()
    for row, number in enumerate(fits.pictures.tolist()):
        of_picture[number] += 1
        faces.append(f"{PurePath(names[number]).stem}_{of_picture[number]}" if found[row] else "")
        source = NAMELESS if isinstance(pictures[number], bytes) else pictures[number]
        problems.append(fits.problems.get(row, "").removeprefix(f"{source}: "))
    return {
        "image": np.array(names, object)[fits.pictures],
        "face": np.array(faces, object),
        "box": np.where(found, np.array(fits.kinds, object), ""),
        **numbers,
        "problem": np.array(problems, object),
    }


def _numbers(*parts: np.ndarray | None) -> np.ndarray:
    """The columns of parts of fits, (columns, N), as they are written."""
    there = [part.reshape(len(part), math.prod(part.shape[1:])) for part in parts if part is not None]
    return np.round(np.concatenate(there, 1), _DIGITS).astype(np.float32).T if there else np.empty((0, 0), np.float32)
