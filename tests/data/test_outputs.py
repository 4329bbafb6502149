"""Files appear whole or not at all."""

import json
import os
import stat
from pathlib import Path

import pytest

from jaxfit.data.outputs import atomic_write, replace_results, require_own_folder, write_csv
from jaxfit.errors import InputError


@pytest.mark.parametrize(("mode", "content"), [("wb", b"\x00\r\n\xff"), ("w", "größe\nx\r\n")])
def test_content_arrives_unchanged(tmp_path, mode, content):
    path = tmp_path / "file"
    with atomic_write(path, mode) as file:
        file.write(content)
    assert path.read_bytes() == (content if mode == "wb" else content.encode())


def write_half(path, error):
    with atomic_write(path, "w") as file:
        file.write("half of it")
        file.flush()
        raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("before", [None, "old"])
def test_an_error_leaves_what_was_there(tmp_path, error, before):
    path = tmp_path / "file"
    if before:
        path.write_text(before)
    with pytest.raises(error):
        write_half(path, error)
    assert [entry.name for entry in tmp_path.iterdir()] == (["file"] if before else [])
    assert not before or path.read_text() == before


def test_nothing_shows_under_the_name_before_the_end(tmp_path):
    path = tmp_path / "file"
    with atomic_write(path, "w") as file:
        file.write("x")
        file.flush()
        assert not path.exists()
    assert path.exists()


def test_files_get_the_permissions_that_plain_files_get(tmp_path):
    (tmp_path / "plain").write_text("")
    with atomic_write(tmp_path / "ours", "w"):
        pass
    plain, ours = (stat.S_IMODE(os.stat(tmp_path / name).st_mode) for name in ("plain", "ours"))
    assert ours == plain


def test_only_files_in_existing_folders_are_written(tmp_path):
    with pytest.raises(InputError, match="does not exist"), atomic_write(tmp_path / "no" / "file"):
        pass
    with pytest.raises(InputError, match="not a regular file"), atomic_write(tmp_path):
        pass


def test_csv_quotes_what_needs_it(tmp_path):
    write_csv(tmp_path / "t.csv", ["a", "b"], [["x,y", 1.5], ['"', None]])
    assert (tmp_path / "t.csv").read_bytes() == b'a,b\n"x,y",1.5\n"""",\n'


def test_a_folder_belongs_to_the_command_that_wrote_to_it(tmp_path):
    require_own_folder(tmp_path / "new", "jaxfit track")
    for written in (["a.csv", "films/b.webm"], ["a.csv"]):
        (tmp_path / "films").mkdir(exist_ok=True)
        for name in written:
            (tmp_path / name).write_text("result")
        require_own_folder(tmp_path, "jaxfit track")
        replace_results(tmp_path, "jaxfit track", written, {})
        assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")} == {*written, "manifest.json"}
    assert not (tmp_path / "films").exists()
    with pytest.raises(InputError, match=r"holds results of `jaxfit track` of 20.*use another --out"):
        require_own_folder(tmp_path, "jaxfit evaluate")


@pytest.mark.parametrize(
    ("before", "now", "words"),
    [
        ({"detector": None}, {"detector": "haar"}, "detector: not given there, haar here"),
        ({"any_rotation": False}, {"any_rotation": True}, "any-rotation: no there, yes here"),
        ({"starts": 1}, {"starts": 11}, "starts: 1 there, 11 here"),
        ({"rotations": [-90.0, 90.0]}, {"rotations": [-45.0, 45.0]}, "rotations: -90 90 there, -45 45 here"),
        ({"model file": "0" * 16}, {"model file": "1" * 16}, "model file: others"),
        ({"labels": {"my_data": "a"}}, {"labels": {"my_data": "b"}}, "labels.my_data: a there, b here"),
        ({"smooth": True}, {"smooth": True}, ""),
    ],
)
def test_other_settings_are_said_in_the_words_of_the_options(
    tmp_path: Path, before: dict, now: dict, words: str
) -> None:
    replace_results(tmp_path, "jaxfit track", [], before)
    said = replace_results(tmp_path, "jaxfit track", [], now)
    assert said.endswith(f" with other settings ({words})") if words else said == ""


@pytest.mark.parametrize("name", ["../kept.txt", "link/kept.txt", "folder", ".", "", "nothing", "a" * 300, "\0"])
def test_what_a_manifest_of_anyone_lists_is_removed_only_in_its_folder(tmp_path: Path, name: str) -> None:
    kept, out = tmp_path / "kept.txt", tmp_path / "out"
    kept.write_text("kept")
    (out / "folder").mkdir(parents=True)
    (out / "link").symlink_to(tmp_path)
    (out / "manifest.json").write_text(json.dumps({"command": "jaxfit fit", "files": [name]}))
    replace_results(out, "jaxfit fit", [], {})
    assert kept.exists()
    assert (out / "folder").is_dir()


def test_text_is_valid_utf_8_whatever_names_are_in_it(tmp_path):
    write_csv(tmp_path / "table.csv", ["image"], [[os.fsdecode(b"\xe9 n\xc3\xa9.jpg")], ["\ud800"]])
    assert (tmp_path / "table.csv").read_text(encoding="utf-8") == "image\n\\xe9 né.jpg\n\\ud800\n"
