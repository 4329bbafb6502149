"""What happens to a run when a call to the file system fails, or is its last one: SQLite's way of testing.

Each call of a small run that changes files fails once, with a full disk or a broken one, or is where the run is killed:
nothing that the run would do afterwards is done. The run after it must write what one writes that nothing happened to.
"""

import builtins
import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from csv_files import labelled_box, write_boxes

from jaxfit.errors import JaxfitError
from jaxfit.fitting.fits import Fits
from jaxfit.runs import FolderRun, fit_folder, folder

_CALLS = ("replace", "rename", "unlink", "rmdir", "mkdir", "fsync", "truncate", "write", "open")


class Killed(BaseException):
    """Where a run ends, and with it all that it would have done."""


class Faults:
    """Counts the calls that change files, and has one of them fail, or be the last.

    Args:
        patch: puts them in place.
        at: the number of the call, from 1; 0 for none.
        code: of the error; None kills.
    """

    def __init__(self, patch: pytest.MonkeyPatch, at: int = 0, code: int | None = None):
        self.count, self._at, self._code, self._dead = 0, at, code, False
        for name in _CALLS:
            patch.setattr(os, name, self._failing(getattr(os, name)))
        patch.setattr(builtins, "open", self._opening(builtins.open))

    def meet(self) -> None:
        """A call."""
        self.count += 1
        if self._dead or (self.count == self._at and self._code is None):
            self._dead = True
            raise Killed
        if self.count == self._at and self._code is not None:
            raise OSError(self._code, os.strerror(self._code))

    def _failing(self, call: Callable) -> Callable:
        def fail(*given: Any, **ways: Any) -> Any:
            if call.__name__ != "open" or given[1] & (os.O_WRONLY | os.O_RDWR):
                self.meet()
            return call(*given, **ways)

        return fail

    def _opening(self, call: Callable) -> Callable:
        def fail(path: Any, mode: str = "r", *given: Any, **ways: Any) -> Any:
            if "x" not in mode and "w" not in mode:
                return call(path, mode, *given, **ways)
            self.meet()
            return _Written(call(path, mode, *given, **ways), self.meet)

        return fail


class _Written:
    """A file whose writing may fail, in the middle."""

    def __init__(self, file: Any, meet: Callable[[], None]):
        self._file, self._meet = file, meet

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> "_Written":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def flush(self) -> None:
        self._file.flush()
        self._meet()


def results(out: Path) -> dict[str, bytes]:
    """All files, hidden ones as well; but for the manifest, which says when."""
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != "manifest.json"
    }


@pytest.fixture
def small(drawn: Path, drawn_model: Path, tmp_path: Path) -> Iterator[tuple[FolderRun, list[Path]]]:
    """A run over three pictures in two chunks, one of them broken; what JAX finds in them is computed once."""
    pictures = [tmp_path / f"{number}.png" for number in range(3)]
    for path in pictures:
        path.write_bytes((drawn / "face000.png").read_bytes())
    pictures[2].write_bytes(b"no picture")
    boxes = write_boxes(tmp_path / "boxes.csv", {path.name: labelled_box(drawn / "face000.png") for path in pictures})
    run = FolderRun(tmp_path / "whole", drawn_model, boxes=boxes)
    stream, load = folder.stream, folder.load
    known: dict[str, Fits] = {}

    def remembered(pipeline: Any, groups: Any, *more: Any) -> Iterator[Fits]:
        for group in groups:
            key = "".join(source.name for source in group)
            if key not in known:
                known[key] = next(stream(pipeline, [group], len(group)))
            yield known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folder, "_CHUNK", 2)
        patch.setattr(folder, "stream", remembered)
        model = load(drawn_model)
        patch.setattr(folder, "load", lambda _: model)
        yield run, pictures


def test_a_run_after_any_fault_gives_what_one_without_gives(
    small: tuple[FolderRun, list[Path]], tmp_path: Path
) -> None:
    run, pictures = small
    fit_folder(run, pictures)
    whole = results(tmp_path / "whole")
    assert {Path(name).parts[0] for name in whole} == {"landmarks.csv", "problems.csv", "pts", "overlays"}
    out = tmp_path / "out"
    faulty = FolderRun(out, run.model, boxes=run.boxes)
    with pytest.MonkeyPatch.context() as patch:
        calls = Faults(patch)
        fit_folder(faulty, pictures)
    assert calls.count > 40
    refused = killed = 0
    for code in (None, errno.EIO, errno.ENOSPC):
        for at in range(1, calls.count + 1):
            shutil.rmtree(out)
            with pytest.MonkeyPatch.context() as patch:
                Faults(patch, at, code)
                try:
                    fit_folder(faulty, pictures)
                except Killed:
                    killed += 1
                except (JaxfitError, OSError):  # which the command says in one line
                    refused += 1
            fit_folder(faulty, pictures)
            assert results(out) == whole, (code, at)
    assert killed == calls.count
    assert refused > calls.count  # others are problems of their picture, or leave what is swept


def test_killed_twice(small: tuple[FolderRun, list[Path]], tmp_path: Path) -> None:
    """Also where the run that goes on is killed, at each of its calls, and the settings are others afterwards."""
    run, pictures = small
    fit_folder(run, pictures)
    whole = results(tmp_path / "whole")
    out = tmp_path / "out"
    faulty = FolderRun(out, run.model, boxes=run.boxes)
    with pytest.MonkeyPatch.context() as patch:
        calls = Faults(patch)
        fit_folder(faulty, pictures)
    for at in range(1, calls.count + 1, 12):
        for again in range(3, calls.count + 1, 12):
            shutil.rmtree(out, ignore_errors=True)
            for last in (at, again):
                with pytest.MonkeyPatch.context() as patch:
                    Faults(patch, last)
                    with suppress(Killed):
                        fit_folder(faulty, pictures)
            other = FolderRun(out, run.model, boxes=run.boxes, refine=False, formats=("jsonl",), overwrite=True)
            fit_folder(other, pictures)
            assert not [name for name in results(out) if name.startswith(".")]
            fit_folder(FolderRun(out, run.model, boxes=run.boxes, overwrite=True), pictures)
            assert results(out) == whole, (at, again)
