"""Names of pictures: their spelling in tables, names of results, and what a name in a table means."""

import os
import sys
import time
import unicodedata
from pathlib import Path

import pytest

from jaxfit.data.names import each_once, pictures_named, plain, printable, table_path, table_word, unique_names
from jaxfit.errors import InputError

linux = pytest.mark.skipif(sys.platform != "linux", reason="names of files are not any bytes elsewhere")


def test_names_of_results_are_unique_and_good_names_of_files() -> None:
    paths = [Path(name) for name in ("a/x.png", "b/x.png", "x-2.png", "c/x.jpg", "d/x-2.png", "y.png", "e/X.png")]
    assert list(unique_names(paths)) == ["x", "x-2", "x-2-2", "x-3", "x-2-3", "y", "X-4"]
    several = list(unique_names(map(Path, ["a.png", "a_1.png", "A.jpg", "a-2.png", "a-2_1.png"])))
    faces = [f"{name}_{number}".casefold() for name in several for number in range(1, 20)]
    assert len({*faces}) == len(faces)
    odd = ["-rf.png", "=1+1.png", 'a\nb"?.png', "c:\\d.png", os.fsdecode(b"\xe9.png"), "né 日.png"]
    assert list(unique_names(map(Path, odd))) == ["_-rf", "_=1+1", "a_b__", "c__d", "_", "né 日"]
    (first, second) = unique_names([Path("日" * 84 + ".png"), Path("日" * 84 + "!.png")])
    assert first == "日" * 66
    assert second == "日" * 66 + "-2"


@pytest.mark.parametrize(
    ("name", "path", "word"),
    [
        ("né 日.png", "né 日.png", "né 日.png"),
        (os.fsdecode(b"\xe9t\xe9"), r"\xe9t\xe9", r"\xe9t\xe9"),
        ("a\nb\x1b\x85\u2028", r"a\x0ab\x1b\u0085\u2028", r"a\x0ab\x1b\u0085\u2028"),
        ("=cmd|' /C calc'!A0", "./=cmd|' /C calc'!A0", "_=cmd|' /C calc'!A0"),
        ("-rf", "./-rf", "_-rf"),
        ("p/=1", "p/=1", "p/=1"),
    ],
)
def test_names_in_tables_are_text_on_one_line_and_no_formulas(name: str, path: str, word: str) -> None:
    assert (table_path(name), table_word(name)) == (path, word)
    assert table_path(name).encode().decode() == path


@linux
def test_no_two_names_are_spelled_the_same() -> None:
    names = [os.fsdecode(b"\xe9"), r"\xe9", r"\\xe9", "\n", r"\x0a", r"\\x0a"]
    assert len(set(map(plain, names))) == len(names)


def test_a_picture_under_several_paths_comes_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    paths = ["a.png", "./a.png", str(tmp_path / "a.png"), "b.png", "nul\0/a.png", "nul\0/a.png"]
    assert list(map(str, each_once(paths))) == ["a.png", "b.png", "nul\0/a.png"]


def test_messages_move_no_cursor() -> None:
    assert printable("two\nlines \x1b[2J\r\u202e né\udce9") == r"two" "\n" r"lines \x1b[2J\x0d\u202e né\xe9"


def test_many_pictures_of_one_name_are_named_and_found_in_linear_time() -> None:
    """What grew with the square took 15 to 20 seconds for these."""
    spellings = [
        "".join(c.upper() if number >> k & 1 else c for k, c in enumerate("abcdefghijkl")) for number in range(4096)
    ]
    pictures = [Path(f"/nowhere/{number:05}/{name}.jpg") for number, name in enumerate(spellings)]
    same = [Path(f"/nowhere/{number:05}/0001.jpg") for number in range(8000)]
    begun = time.process_time()
    assert len({name.casefold() for name in unique_names(pictures)}) == len(pictures)
    assert len({*unique_names(same)}) == len(same)
    meant = pictures_named([f"{number:05}/0001.jpg" for number in range(8000)], same)
    assert [found for (found,) in meant.values()] == same
    assert time.process_time() - begun < 5


def test_names_are_found_in_linear_time_relative_to_a_folder() -> None:
    def seconds(count: int) -> float:
        pictures = [Path(f"/nowhere/{number:05}/0001.jpg") for number in range(count)]
        begun = time.process_time()
        meant = pictures_named([f"{number:05}/0001.jpg" for number in range(count)], pictures, ["/nowhere"])
        assert len(meant) == count
        return time.process_time() - begun

    once = min(seconds(1000) for _ in range(3))
    assert min(seconds(8000) for _ in range(2)) < 30 * once  # with the square of the number, 44 times as long


PICTURES = ("p1/001.jpg", "p2/001.jpg", "p2/deep/p1/001.jpg", "p1/002.jpg", "003.jpg", "p1/003.jpg", "=4.jpg")


@pytest.mark.parametrize(
    ("name", "picture"),
    [
        ("p1/001.jpg", "p1/001.jpg"),  # also the end of another's path
        ("./p2/../p2/001.jpg", "p2/001.jpg"),
        ("HERE/p2/001.jpg", "p2/001.jpg"),
        ("deep/p1/001.jpg", "p2/deep/p1/001.jpg"),
        ("002.jpg", "p1/002.jpg"),
        (" 002.jpg ", "p1/002.jpg"),
        ("p1\\002.jpg", "p1/002.jpg"),
        ("003.jpg", "003.jpg"),
        ("./=4.jpg", "=4.jpg"),
        ("p3/001.jpg", None),
        ("/elsewhere/p1/001.jpg", None),
        ("1.jpg", None),
        ("p1", None),
        (".", None),
    ],
)
def test_a_name_in_a_table_means_one_picture(name: str, picture: str | None, tmp_path: Path) -> None:
    pictures = [tmp_path / each for each in PICTURES]
    name = name.replace("HERE", str(tmp_path))
    assert pictures_named([name], pictures, [tmp_path]) == ({} if picture is None else {name: [tmp_path / picture]})


def test_a_name_that_may_mean_two_pictures_is_refused_with_both(tmp_path: Path) -> None:
    pictures = [tmp_path / each for each in PICTURES]
    for folders in ([], [tmp_path / "p1", tmp_path / "p2"]):
        with pytest.raises(InputError, match=rf"'001.jpg' may mean {pictures[0]} or {pictures[1]}"):
            pictures_named(["001.jpg"], pictures[:2], folders)
    # One picture under two paths is one picture.
    (tmp_path / "p1").mkdir()
    (tmp_path / "link").symlink_to("p1")
    both = [tmp_path / "p1" / "9.jpg", tmp_path / "link" / "9.jpg"]
    assert pictures_named(["9.jpg", "link/9.jpg"], both, [tmp_path]) == {"9.jpg": both, "link/9.jpg": both}


@linux
def test_names_are_known_as_they_are_and_as_tables_spell_them(tmp_path: Path) -> None:
    for name in (os.fsdecode(b"\xe9.jpg"), "a\nb.jpg", "c\\d.jpg", r"\xe9.png", "=1.jpg", "-r.jpg", " e.jpg"):
        picture = tmp_path / name
        for spelling in (name, table_path(name), table_path(picture)):
            assert pictures_named([spelling], [picture], [tmp_path]) == {spelling: [picture]}


@linux
def test_accents_match_however_they_are_composed(tmp_path: Path) -> None:
    composed, decomposed = "Zoë/é.jpg", unicodedata.normalize("NFD", "Zoë/é.jpg")
    assert composed != decomposed
    for name, other in ((composed, decomposed), (decomposed, composed)):
        assert pictures_named([name, Path(name).name], [tmp_path / other], [tmp_path]) == {
            name: [tmp_path / other],
            Path(name).name: [tmp_path / other],
        }
    # Where both are there, each name means its own.
    both = [tmp_path / composed, tmp_path / decomposed]
    assert pictures_named([decomposed], both, [tmp_path]) == {decomposed: both[1:]}
