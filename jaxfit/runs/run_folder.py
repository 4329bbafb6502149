"""The folder of a run's results while the run goes on: what it has found so far, and what that was found in."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxfit.data.inputs import state_of
from jaxfit.data.outputs import atomic_write, discard, require_same_settings, results_in
from jaxfit.data.rows import PROBLEM, Row
from jaxfit.errors import InputError
from jaxfit.fitting.pipeline import Fitting
from jaxfit.models.files import BUNDLED, read_named

_UNFINISHED, _SETTINGS, _OUTPUTS = ".unfinished", "settings.json", "outputs.json"


class RunFolder:
    """Chunks of pictures that are done, in ``.unfinished`` of a folder of results that this process holds.

    A chunk is there as a whole or not at all, and is bound to the settings of the run and to the sizes and times of its
    pictures: what was found by others, or in others, does not count.

    Args:
        out: the folder of results; it exists.
    """

    def __init__(self, out: Path):
        self._out, self._folder = out, out / _UNFINISHED
        self._chunks: list[Path] = []

    @property
    def begun(self) -> bool:
        """Whether an unfinished run is there."""
        return self._folder.is_dir()

    def written(self) -> set[Path]:
        """The files that runs wrote, or may have written: the one that has finished and the one that has not."""
        try:
            planned = json.loads((self._folder / _OUTPUTS).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            planned = []
        return {self._out / name for name in (*results_in(self._out), *planned)}

    def begin(self, settings: dict[str, Any], chunks: Sequence[Sequence[Path]], outputs: Iterable[str]) -> None:
        """Begin a run, or go on with one of the same settings.

        Args:
            settings: JSON values, which have to be the same.
            chunks: the pictures of each.
            outputs: names of the files, in the folder of results, that pictures may be written to.

        Raises:
            InputError: the settings are others.
        """
        self._folder.mkdir(exist_ok=True)
        try:
            require_same_settings(self._folder / _SETTINGS, settings)
        except InputError as error:
            raise InputError(f"{error}, or overwrite (--overwrite) to begin anew") from None
        of_run = json.dumps(settings, sort_keys=True)
        self._chunks = [
            self._folder / f"{number:07}-{digest(f'{of_run} {state_of(pictures)}'.encode())}.jsonl"
            for number, pictures in enumerate(chunks)
        ]
        for path in {*self._folder.glob("*.jsonl")} - {*self._chunks}:  # of pictures that have changed
            path.unlink()
        if not (self._folder / _OUTPUTS).exists():
            with atomic_write(self._folder / _OUTPUTS, "w") as file:
                json.dump(list(outputs), file)

    def has(self, number: int) -> bool:
        """Whether this chunk is there."""
        return self._chunks[number].exists()

    def put(self, number: int, rows: Iterable[Row]) -> None:
        """Keep the rows of a chunk of pictures, and those that say what was wrong."""
        with atomic_write(self._chunks[number], "w") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)

    def faces(self) -> Iterator[Row]:
        """The fitted faces of all chunks, in order.

        Raises:
            InputError: a chunk is missing.
        """
        return (row for row in self._rows() if PROBLEM not in row)

    def problems(self) -> Iterator[Row]:
        """The rows of all chunks that say what was wrong, in order; as `faces`."""
        return (row for row in self._rows() if PROBLEM in row)

    def discard(self) -> None:
        """Remove what is there of a run; at once, so that no part of it is taken for a whole."""
        discard(self._folder)

    def _rows(self) -> Iterator[Row]:
        for path in self._chunks:
            try:
                with path.open(encoding="utf-8") as lines:
                    yield from map(json.loads, lines)
            except FileNotFoundError:
                raise InputError(
                    f"{path} is missing: something else has removed what this run had found; run it again"
                ) from None


def run_files(model: str | Path, fitting: Fitting, boxes: str | Path | None = None) -> dict[str, Path]:
    """The files beside the pictures that a run reads, by what they are; what comes with the package is none."""
    detector = fitting.settings()["detector"] or ""
    named = {"model": model, "detector": detector.partition(":")[2], "boxes": boxes}
    return {kind: Path(name) for kind, name in named.items() if name and Path(name).is_file()}


def file_digests(model: str | Path, files: Mapping[str, Path]) -> dict[str, str]:
    """What is in the model and in the other files of `run_files`, in settings that have to be the same."""
    contents = {kind: path.read_bytes() for kind, path in files.items()} | {
        "model": read_named(model, BUNDLED, "model")
    }
    return {f"{kind} file": digest(data) for kind, data in contents.items()}


def digest(data: bytes) -> str:
    """What settings and chunks are known by: 16 letters, others for other data."""
    return hashlib.sha256(data).hexdigest()[:16]
