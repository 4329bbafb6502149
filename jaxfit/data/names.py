"""Names of pictures: how tables spell them, what their results are called, and which picture a name in a table means.

Only paths distinguish pictures of several folders. A name of a file may be almost any bytes, a table
may not: see `plain`.
"""

import os
import re
import unicodedata
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path, PurePath

from jaxfit.errors import InputError

# Bytes that are not UTF-8 (Python has surrogates for them), control characters, and what some programs take for line
# ends. Where a backslash is no separator it is doubled, so that no two names are spelled the same.
_ODD = re.compile("[\ud800-\udfff\x00-\x1f\x7f-\x9f\u2028\u2029]" + (r"|\\" if os.sep == "/" else ""))
_CONTROL = re.compile("[\ud800-\udfff\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")
# What spreadsheets begin a formula with: a table that is opened there must not run what a file is called. A space or a
# quote before it, the usual cure, would change the name; the cures here do not: "./=1.jpg" is the path of "=1.jpg".
_FORMULA = ("=", "+", "-", "@")
# What some system does not allow in names of files, or takes for a separator.
_UNPORTABLE = re.compile('[\ud800-\udfff\x00-\x1f\x7f-\x9f\u2028\u2029\\\\/:*?"<>|]')
_LONGEST = 200  # bytes of a result's name; file systems mostly allow 255, numbers and suffixes included


def plain(name: str) -> str:
    r"""A name as tables spell it, which is always valid UTF-8 on one line, and never the spelling of another name.

    A byte that is not UTF-8 and a control character become ``\xe9`` and ``\x0a``, a line separator ``\u2028``, and a
    backslash of a system where it does not separate folders ``\\``.
    """
    return _ODD.sub(_escape, name)


def printable(text: str) -> str:
    r"""A message as terminals may have it: control characters become ``\x1b``, but for line ends.

    What files are called would otherwise move the cursor, recolour the screen, or type for the user.
    """
    return _CONTROL.sub(_escape, text)


def _escape(found: re.Match[str]) -> str:
    if found[0] == "\\":
        return r"\\"
    code = ord(found[0])
    if 0xDC80 <= code <= 0xDCFF:  # Python's surrogate of a byte that is not UTF-8
        return f"\\x{code - 0xDC00:02x}"
    return f"\\x{code:02x}" if code < 0x80 else f"\\u{code:04x}"


def table_path(path: str | PurePath) -> str:
    """The path of a file as tables spell it: `plain`, and after ``./`` if it began like a formula or an option."""
    text = plain(str(path))
    return f"./{text}" if text.startswith(_FORMULA) else text


def table_word(word: str) -> str:
    """Another name, such as a person's, as tables spell it: `plain`, and after ``_`` if it began like a formula."""
    text = plain(word)
    return f"_{text}" if text.startswith(_FORMULA) else text


def real_path(path: str | Path) -> str:
    """A path without links, absolute; as it is given where none can be, as with a null character in it."""
    try:
        return os.path.realpath(path)
    except ValueError:
        return str(path)


def each_once(pictures: Iterable[str | Path]) -> list[Path]:
    """Pictures without those that were there before under another path, as ``a.jpg`` and ``/photos/a.jpg``, or through
    a link to a folder. A link to a picture is a picture of its own."""
    real = cache(real_path)
    places: dict[str, Path] = {}
    for path in map(Path, pictures):
        places.setdefault(os.path.join(real(path.parent), path.name), path)
    return list(places.values())


def _composed(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def unique_names(pictures: Iterable[PurePath]) -> Iterator[str]:
    """What the results of each picture are called: its stem, numbered where several pictures share it.

    Names are good names of files on all systems: what is not becomes ``_``, long ones are cut, and none differ by case
    only.
    """
    taken: set[str] = set()
    numbers: dict[str, int] = {}  # by what does not differ in case: "A", "a" and "A" again count on, in linear time
    for picture in pictures:
        stem = name = _portable(picture.stem)
        same = stem.casefold()
        while name.casefold() in taken:
            numbers[same] = numbers.get(same, 1) + 1
            name = f"{stem}-{numbers[same]}"
        taken.add(name.casefold())
        yield name


def _portable(stem: str) -> str:
    name = _UNPORTABLE.sub("_", stem)
    name = f"_{name}" if name.startswith(_FORMULA) else name
    return name.encode()[:_LONGEST].decode(errors="ignore")


class PathsByEnd:
    """Paths by how they end, in time that does not grow with how many end alike.

    Args:
        paths: absolute, with this system's separators.
    """

    def __init__(self, paths: Iterable[str]):
        self._parts = [(path, path.split(os.sep)) for path in paths]
        self._deepest = max((len(parts) for _, parts in self._parts), default=0)
        self._by_end: dict[int, dict[str, list[str]]] = {}  # by how many parts an end has

    def ending(self, end: str) -> list[str]:
        """Those that end with this relative path."""
        count = end.count(os.sep) + 1
        if count >= self._deepest or os.path.isabs(end):
            return []
        if count not in self._by_end:
            ends = self._by_end[count] = {}
            for path, parts in self._parts:
                ends.setdefault(os.sep.join(parts[-count:]), []).append(path)
        return self._by_end[count].get(end, [])

    def sharing(self, path: str) -> list[str]:
        """Those that share the most parts at their ends with a path, the last one at least."""
        parts = path.split(os.sep)
        for count in range(min(len(parts), self._deepest - 1), 0, -1):
            if found := self.ending(os.sep.join(parts[-count:])):
                return found
        return []


def pictures_named(
    names: Iterable[str], pictures: Iterable[Path], folders: Iterable[str | Path] = ()
) -> dict[str, list[Path]]:
    """Which pictures names in a table mean, by name; those that mean none are left out.

    A name is a path: absolute, or relative to one of ``folders`` or to the working folder. If no picture is there, it
    is the end of a path, such as a bare file name, as long as only one picture's path ends so. Separators may be those
    of Windows, and names may be spelled as they are or as in tables of jaxfit. Letters with accents may be one
    character or two, which systems differ in, if no picture is spelled exactly so.

    Args:
        names: from a table.
        pictures: that may be meant; one that comes under several paths is one picture.
        folders: that paths may be relative to.

    Raises:
        InputError: a name may mean several pictures.
    """
    places: dict[str, list[Path]] = {}
    real = cache(os.path.realpath)  # without links to folders; a link to a picture is a picture of its own
    for picture in dict.fromkeys(pictures):
        place = os.path.join(plain(real(picture.parent)), plain(picture.name))
        places.setdefault(place, []).append(picture)
    # As they are composed: what a system has decomposed, as macOS does, is the same name.
    composed: dict[str, list[str]] = {}
    for place in places:
        composed.setdefault(_composed(place), []).append(place)
    by_end, composed_by_end = PathsByEnd(places), PathsByEnd(composed)
    bases = [plain(real(base)) for base in dict.fromkeys([*map(str, folders), "."])]
    found = {}
    for name in dict.fromkeys(names):
        for spelling in dict.fromkeys([name, plain(name), name.strip(), name.strip().replace("\\", "/")]):
            path = os.path.normpath(spelling)
            folder, file = os.path.split(path)
            there = {os.path.join(real(os.path.join(base, folder)), file) for base in bases}
            meant = (
                {place for place in there if place in places}  # set.intersection goes through all places
                or {*by_end.ending(path)}
                or {place for each in there for place in composed.get(_composed(each), ())}
                or {place for each in composed_by_end.ending(_composed(path)) for place in composed[each]}
            )
            if len(meant) > 1:
                some = [str(places[place][0]) for place in sorted(meant)][:2]
                raise InputError(
                    f"{name!r} may mean {some[0]} or {some[1]}; expected a name of one picture: give more of its path"
                )
            if meant:
                found[name] = places[meant.pop()]
                break
    return found
