"""Writing files whole or not at all: a crash, a full disk or Ctrl-C never leaves half a file under the final name.

Text is always valid UTF-8: a byte of a file's name that is not becomes ``\\xe9`` (`jaxfit.data.names.plain`).
"""

import codecs
import csv
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import IO, Any, Literal

import jaxfit
from jaxfit.data.names import plain
from jaxfit.errors import InputError

MANIFEST = "manifest.json"  # of a folder of results: what a run wrote, which command it was, and when
_SPELLED = "jaxfit.spelled"
# What files are called until they are whole, and folders until they are gone.
_DIGEST = re.compile(r"[0-9a-f]{16}")  # as run folders' settings have them
_HIDDEN = re.compile(r"\.[0-9a-f]{16}\.tmp(\.\w+)?")


def _spelled(error: UnicodeError) -> tuple[str, int]:
    """What to write for what UTF-8 cannot: surrogates, which names of files have for bytes that are no text."""
    assert isinstance(error, UnicodeEncodeError)
    return plain(error.object[error.start : error.end]), error.end


codecs.register_error(_SPELLED, _spelled)


def require_own_folder(folder: str | Path, command: str) -> None:
    """Check that a folder of results is a command's own: new, without results, or with those of an earlier run of it.

    Raises:
        InputError: another command wrote there, or the manifest is damaged.
    """
    before = _manifest(Path(folder))
    if before is not None and before["command"] != command:
        raise InputError(
            f"{folder} holds results of `{before['command']}` of {before['when']}; expected a new folder, or one that "
            f"`{command}` wrote to: use another --out"
        )


def results_in(folder: str | Path) -> list[str]:
    """The files of a folder of results that its manifest lists, by their paths in it; none if there is no manifest, or
    a damaged one. What is in another folder, links included, is left out."""
    try:
        listed = (_manifest(Path(folder)) or {"files": []})["files"]
    except InputError:
        return []
    folder = Path(folder)
    top = folder.resolve()

    @cache  # many files are in one folder
    def is_within(parent: Path) -> bool:
        return parent.resolve().is_relative_to(top)

    def is_own(name: str) -> bool:
        try:
            return "\0" not in name and is_within((folder / name).parent) and not (folder / name).is_dir()
        except (OSError, ValueError):
            return False

    return [name for name in listed if is_own(name)]


def replace_results(
    folder: str | Path, command: str, written: Iterable[str], settings: dict[str, Any], others: Iterable[str] = ()
) -> str:
    """Remove what the run before this one wrote to a folder and this one did not, and write this one's manifest;
    returns a sentence about that run if its settings were others, else an empty one.

    Files that no manifest lists stay.

    Args:
        folder: of the results.
        command: that wrote them.
        written: its files, by their paths in the folder.
        settings: JSON values, for readers.
        others: files that are removed as well, unless this run wrote them.
    """
    folder, files = Path(folder), sorted({*written})
    replaced = _replaced(folder, json.loads(json.dumps(settings)))
    for name in sorted({*results_in(folder), *others} - {*files}):
        path = folder / name
        path.unlink(missing_ok=True)
        if path.parent != folder:
            with suppress(OSError):  # others' files are in it
                path.parent.rmdir()
    account = {
        "command": command,
        "jaxfit": jaxfit.__version__,
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "settings": settings,
        "files": files,
    }
    with atomic_write(folder / MANIFEST, "w") as file:
        json.dump(account, file, indent=1)
    return replaced


def _replaced(folder: Path, settings: dict[str, Any]) -> str:
    """A sentence about the run whose results are replaced, if its settings, JSON values, were others."""
    try:
        before = _manifest(folder)
    except InputError:  # replaced all the same, as was asked for
        return f"replaced what an earlier run wrote to {folder}; its {MANIFEST} was damaged"
    if before is None or before.get("settings") == settings:
        return ""
    known = before.get("settings")
    changed = "; ".join(_differences(known if isinstance(known, dict) else {}, settings))
    return f"replaced what `{before['command']}` wrote to {folder} at {before['when']} with other settings ({changed})"


def _manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a folder of results, if there is one."""
    path = folder / MANIFEST
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        files = found["files"]
        if not (
            isinstance(found["command"], str)
            and isinstance(files, list)
            and all(isinstance(name, str) for name in files)
        ):
            raise ValueError("a command that is no text, or files that are no list of names")
        return {"when": "unknown time"} | found
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path}: expected the manifest of a folder of jaxfit's results ({error}); use another --out, or remove it"
        ) from None


def require_same_settings(path: str | Path, settings: dict[str, Any]) -> None:
    """Write the settings (JSON values) of a folder of results to ``path``, or compare them with those written before.

    Raises:
        InputError: they differ: results of different settings must not be mixed.
    """
    path = Path(path)
    settings = json.loads(json.dumps(settings))
    if not path.exists():
        with atomic_write(path, "w") as file:
            json.dump(settings, file, indent=2)
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(before, dict):
            raise ValueError("no table")
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected the settings of a run, as JSON ({error}); use another --out") from None
    if before != settings:
        changed = "; ".join(_differences(before, settings))
        raise InputError(f"{path.parent} holds results of other settings ({changed}); use another --out")


def _differences(before: dict[str, Any], now: dict[str, Any], within: str = "") -> Iterator[str]:
    """Where settings differ, and how, in the words of the command's options; tables in them by their keys."""
    for key in sorted({*before, *now}):
        was, is_now = before.get(key), now.get(key)
        name = f"{within}{key}" if within else key.replace("_", "-")
        if isinstance(was, dict) and isinstance(is_now, dict):
            yield from _differences(was, is_now, f"{name}.")
        elif was != is_now and all(isinstance(value, str) and _DIGEST.fullmatch(value) for value in (was, is_now)):
            yield f"{name}: others"
        elif was != is_now:
            yield f"{name}: {_as_given(was)} there, {_as_given(is_now)} here"


def _as_given(value: Any) -> str:
    """A setting, a JSON value, as it stands on a command line."""
    if value is None:
        return "not given"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return " ".join(map(_as_given, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def not_written(path: str | Path, error: Exception) -> str:
    """Why a file of one of many pictures could not be written, for the problems of that picture."""
    reason = error.strerror if isinstance(error, OSError) else None
    return f"cannot write {path}: {reason}" if reason else str(error)


def discard(folder: str | Path) -> None:
    """Remove a folder with all that is in it; it is gone from under its name at once, whole, whatever happens then."""
    folder = Path(folder)
    hidden = _hidden(folder.parent)
    with suppress(FileNotFoundError):
        os.rename(folder, hidden)
        shutil.rmtree(hidden, ignore_errors=True)  # what stays is swept


def sweep(folder: str | Path) -> None:
    """Remove what writing left in a folder, and in the folders in it, when a process was killed: only the one process
    that may write there knows that no other process is at work on it."""
    with os.scandir(folder) as entries:
        found = [entry for entry in entries if not entry.is_symlink()]
    for entry in found:
        hidden = _HIDDEN.fullmatch(entry.name)
        if entry.is_dir():
            if hidden:
                shutil.rmtree(entry.path, ignore_errors=True)
            else:
                _sweep_files(entry.path)
        elif hidden:
            os.unlink(entry.path)


def _sweep_files(folder: str) -> None:
    with suppress(PermissionError), os.scandir(folder) as entries:  # a folder of others, who closed it
        for entry in entries:
            if _HIDDEN.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                os.unlink(entry.path)


def _hidden(folder: Path, suffix: str = "") -> Path:
    """A new name in a folder, of what is not whole yet, or no longer."""
    return folder / f".{secrets.token_hex(8)}.tmp{suffix}"


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """The name of a file to write that becomes ``path`` when the block ends, and vanishes when the block raises.

    It ends like ``path``, for programs that tell the format by the name.

    Raises:
        InputError: the folder does not exist, or ``path`` is something other than a file.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"cannot write {path}: the folder {path.parent} does not exist; create it first")
    # Replacing a device such as /dev/null, or a folder, would destroy it.
    if path.exists() and not path.is_file():
        raise InputError(f"cannot write {path}: it exists and is not a regular file; name a file instead")
    # In the same folder, because a file can only be renamed atomically within one file system.
    temporary = _hidden(path.parent, path.suffix)
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def atomic_write(path: str | Path, mode: Literal["w", "wb"] = "wb") -> Iterator[IO[Any]]:
    """A file to write to that becomes ``path`` when the block ends, and vanishes when the block raises.

    Text (``mode="w"``) is UTF-8, and newlines are written as they are given.

    Raises:
        InputError: as :func:`atomic_path`.
    """
    text: dict[str, str] = {} if "b" in mode else {"encoding": "utf-8", "newline": "", "errors": _SPELLED}
    # Plain open() instead of tempfile, whose files nobody else may read.
    with (
        atomic_path(path) as temporary,
        open(temporary, mode.replace("w", "x"), **text) as file,  # type: ignore[call-overload]
    ):
        yield file
        file.flush()
        os.fsync(file.fileno())


def write_csv(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write ``rows`` under ``header`` as comma-separated values, atomically.

    Raises:
        InputError: as :func:`atomic_write`.
    """
    with atomic_write(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
