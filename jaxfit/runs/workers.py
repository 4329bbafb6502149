"""Fitting pictures batch by batch in workers of any kind: a process pool's, Ray's, Dask's or Spark's."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.compile_cache import keep_compiled_code
from jaxfit.data.limits import DEFAULT_MEGAPIXELS, at_most_megapixels
from jaxfit.data.names import table_path
from jaxfit.data.pictures import NAMELESS, kind_of
from jaxfit.data.rows import FLAGS, PROBLEM, TEXTS
from jaxfit.data.threads import at_most_cores
from jaxfit.errors import InputError
from jaxfit.fitting.fit import name_of
from jaxfit.fitting.fits import Fits
from jaxfit.fitting.pipeline import Fitting, Pipeline, require_fitting
from jaxfit.fitting.refine import refine
from jaxfit.fitting.sources import Source
from jaxfit.fitting.stream import stream
from jaxfit.heads.with_heads import ensure_heads
from jaxfit.models.files import BUNDLED, DEFAULT_MODEL, load, read_named


@dataclass(frozen=True)
class BatchFitter:
    """Fits batches of pictures: columns in, columns out. It holds its settings only, so that it is small when it is
    sent to workers; each process loads the model when its first batch comes, once.

    Attributes:
        model: a bundled model's name, or a model file that every worker can read.
        fitting: how faces are found, by a detector that comes by name, and fitted.
        refine: refine 3D alignments, as ``jaxfit.refine`` does.
        cores: how many cores a worker's threads use: 1, if there is a worker for each core.
        max_megapixels: the largest picture that is read, in million pixels; larger ones are problems.
        unshift: move fits of models whose labels lay beside what they mark onto it (``Model.unshifted``).
        heads: find heads with 2D models, as ``jaxfit.with_heads`` does.

    Raises:
        InputError: no such detector, or a number out of range.
        ModelError: no such model.
    """

    model: str | Path = DEFAULT_MODEL
    fitting: Fitting = field(default_factory=Fitting)
    refine: bool = False
    cores: int = 1
    max_megapixels: float = DEFAULT_MEGAPIXELS
    unshift: bool = False
    heads: bool = False

    def __post_init__(self) -> None:
        # Not the model's contents: who sends this to workers need not have JAX take a device.
        read_named(self.model, BUNDLED, "model")
        require_fitting(self.fitting)
        self.fitting.settings()
        self.fitting.finder()
        with at_most_megapixels(self.max_megapixels):  # if it is a number that may be
            pass
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
        pipeline = _pipeline(self.model, self.fitting, self.cores, self.unshift, self.heads)
        sources = [Source(picture, name_of(picture)) for picture in pictures]
        with at_most_cores(self.cores), at_most_megapixels(self.max_megapixels):
            (fits,) = stream(pipeline, [sources], len(sources))
            fits = refine(pipeline.model, fits) if self.refine else fits
        return _columns(fits, names)


def _pictures(batch: Any) -> tuple[list[str], list[Path | bytes]]:
    """What the pictures of a batch are called in tables, and their files or what is in those."""
    if not ("image" in batch or "path" in batch):
        raise InputError(f"expected a column of files, image or path; got {', '.join(map(str, batch)) or 'no column'}")
    column = "image" if "image" in batch else "path"
    given = [_file(column, name) for name in batch[column]]
    names = list(map(table_path, given))
    if "bytes" not in batch:
        return names, [Path(name) for name in given]
    return names, [_bytes(data) for data in batch["bytes"]]


def _file(column: str, name: Any) -> str:
    """The name of a file in a column, or of other bytes."""
    name = name.as_py() if hasattr(name, "as_py") else name  # Arrow's
    if isinstance(name, str | os.PathLike | int | float | None):
        return str(name)
    raise InputError(
        f"expected names of files in the column {column}; got {kind_of(name)}: give files, or what is in them in a "
        "column bytes (of Ray, read_binary_files instead of read_images); jaxfit.fit takes arrays"
    )


def _bytes(data: Any) -> bytes:
    """What is in a file, of a column."""
    data = data.as_py() if hasattr(data, "as_py") else data
    if isinstance(data, bytes | bytearray | memoryview | None):
        return bytes(data or b"")
    raise InputError(f"expected what is in the pictures' files in the column bytes; got {kind_of(data)}")


@cache
def _pipeline(model: str | Path, fitting: Fitting, cores: int, unshift: bool, heads: bool) -> Pipeline:
    """What a process needs, once."""
    os.environ.setdefault("NPROC", str(cores))  # how many threads XLA starts, if it has not begun yet
    keep_compiled_code()
    loaded = load(model)
    loaded = loaded.unshifted() if unshift else loaded
    return fitting.pipeline(ensure_heads(loaded) if heads else loaded)


def _columns(fits: Fits, names: Sequence[str]) -> dict[str, np.ndarray]:
    """What `BatchFitter` returns."""
    rows = replace(fits, names=tuple(names)).to_dicts(problems=True)
    for row in rows:  # of bytes, too, the picture stands in another column
        row[PROBLEM] = row[PROBLEM].removeprefix(f"{NAMELESS}: ")

    def column(name: str) -> np.ndarray:
        values = [row[name] for row in rows]
        if name in TEXTS:
            return np.array(values, object)
        return np.array([value is True for value in values], bool) if name in FLAGS else np.array(values, np.float32)

    return {name: column(name) for name in (*fits.columns, PROBLEM)}
