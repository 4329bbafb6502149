"""What a run keeps of its pictures: bound to what it was found in, one process at a time, gone in one piece."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from jaxfit.data.locks import held
from jaxfit.errors import InputError
from jaxfit.runs.run_folder import RunFolder

SETTINGS = {"model": "a"}


@pytest.fixture
def pictures(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / f"{number}.jpg" for number in range(4)]
    for path in paths:
        path.write_bytes(path.name.encode())
    return paths


@pytest.fixture
def out(tmp_path: Path) -> Path:
    (tmp_path / "out").mkdir()
    return tmp_path / "out"


def begin(out: Path, pictures: list[Path], settings: dict[str, Any] = SETTINGS) -> RunFolder:
    folder = RunFolder(out)
    folder.begin(settings, [pictures[:2], pictures[2:]], ["overlays/0.jpg"])
    return folder


def fill(out: Path, pictures: list[Path]) -> RunFolder:
    folder = begin(out, pictures)
    for number in range(2):
        folder.put(number, [{"image": str(number)}])
    return folder


def test_what_was_found_is_found_again(out: Path, pictures: list[Path]) -> None:
    fill(out, pictures)
    again = begin(out, pictures)
    assert [again.has(number) for number in range(2)] == [True, True]
    assert [row["image"] for row in again.faces()] == ["0", "1"]


def _replaced(path: Path) -> None:
    path.write_bytes(b"another picture")


def _of_the_same_size(path: Path) -> None:
    path.write_bytes(path.read_bytes()[::-1])
    os.utime(path, ns=(1, 1))


@pytest.mark.parametrize("change", [_replaced, _of_the_same_size, Path.unlink])
def test_pictures_that_have_changed_are_done_anew(out: Path, pictures: list[Path], change: Any) -> None:
    fill(out, pictures)
    change(pictures[2])
    again = begin(out, pictures)
    assert [again.has(number) for number in range(2)] == [True, False]
    assert len(list((out / ".unfinished").glob("*.jsonl"))) == 1


def test_chunks_without_their_settings_are_nobodys(out: Path, pictures: list[Path]) -> None:
    """As a run of an earlier version left them that was killed while it removed its folder."""
    fill(out, pictures)
    (out / ".unfinished" / "settings.json").unlink()
    again = begin(out, pictures, {"model": "b"})
    assert not any(again.has(number) for number in range(2))
    with pytest.raises(InputError, match=r"model: b there, a here\).*overwrite \(--overwrite\) to begin anew"):
        begin(out, pictures)


def test_damaged_settings_are_said(out: Path, pictures: list[Path]) -> None:
    fill(out, pictures)
    for content in ("", "[]", "\0"):
        (out / ".unfinished" / "settings.json").write_text(content)
        with pytest.raises(InputError, match="expected the settings of a run"):
            begin(out, pictures)


def test_no_table_without_all_chunks(out: Path, pictures: list[Path]) -> None:
    folder = fill(out, pictures)
    next(iter((out / ".unfinished").glob("0000001-*"))).unlink()
    with pytest.raises(InputError, match=r"0000001-\w+.jsonl is missing.*run it again"):
        list(folder.faces())


def test_a_folder_that_is_being_removed_is_gone_at_once(
    out: Path, pictures: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = fill(out, pictures)
    monkeypatch.setattr(shutil, "rmtree", lambda *_, **__: None)  # where a run is killed
    folder.discard()
    assert not folder.begun
    assert len(list(out.glob(".*.tmp/*.jsonl"))) == 2
    monkeypatch.undo()
    for name in ("notes.tmp", ".hidden", ".1234.tmp"):
        (out / name).write_text("mine")
    (out / "pts").mkdir()
    for path in (out / f".{'0' * 16}.tmp.csv", out / "pts" / f".{'f' * 16}.tmp.pts"):
        path.write_text("half")
    with held(out, "jaxfit fit"):
        assert sorted(path.name for path in out.iterdir()) == sorted(
            [".1234.tmp", ".hidden", ".jaxfit-lock", "notes.tmp", "pts"]
        )
        assert not list((out / "pts").iterdir())


def test_written_files_are_known_while_a_run_is_unfinished(out: Path, pictures: list[Path]) -> None:
    folder = begin(out, pictures)
    (out / "manifest.json").write_text(json.dumps({"command": "jaxfit fit", "files": ["a.csv", "../b", "/c"]}))
    assert folder.written() == {out / "a.csv", out / "overlays" / "0.jpg"}


HOLDS = """
import sys
from jaxfit.data.locks import held
with held(sys.argv[1], "jaxfit fit"):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(out: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process, which holds the folder until it is killed."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(out)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


@pytest.mark.skipif(os.name != "posix", reason="locks are POSIX's")
def test_one_process_at_a_time(out: Path, holder: subprocess.Popen[str]) -> None:
    words = rf"is being written by `jaxfit fit`, process {holder.pid} on .*use another --out"
    with pytest.raises(InputError, match=words), held(out, "jaxfit track"):
        pass
    os.kill(holder.pid, signal.SIGSTOP)  # who is stopped still holds it
    with pytest.raises(InputError, match=words), held(out, "jaxfit fit"):
        pass
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    with held(out, "jaxfit fit"), pytest.raises(InputError, match=f"process {os.getpid()} "), held(out, "jaxfit fit"):
        pass
    assert not list(out.iterdir())


def test_a_link_for_a_lock_is_not_followed(out: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (out / ".jaxfit-lock").symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match="expected a folder to write to"), held(out, "jaxfit fit"):
        pass
    assert (tmp_path / "precious").read_text() == "mine"
