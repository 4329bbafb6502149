"""The rooms of the package: each says what it is for, and imports only from rooms above it.

``python tests/test_rooms.py`` prints the order.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "jaxfit"
# From the foundations up: a room may import from itself and from those before it.
ROOMS = (
    "errors",
    "types",
    "environment",
    "modes",
    "processes",
    "compile_cache",
    "image",
    "descriptors",
    "schemes",
    "shapes",
    "cascade",
    "data",
    "models",
    "heads",
    "labels",
    "fitting",
    "evaluation",
    "learning",
    "runs",
    "experiments",
    "serving",
    "cli",
)
# Rooms of pure JAX: neither OpenCV nor files.
PURE = ("image", "descriptors", "shapes", "cascade")
MODULES = sorted(PACKAGE.rglob("*.py"))


@cache
def parsed(path: Path) -> ast.Module:
    """The syntax tree of a module."""
    return ast.parse(path.read_text(encoding="utf-8"))


def room_of(path: Path) -> str:
    """The room of a module; empty for the package's own, which may import from all."""
    first = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    return "" if first.startswith("__") else first


def imports(path: Path) -> Iterator[str]:
    """The modules that a module imports, wherever in it, by their full names."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: expected absolute imports"
            yield node.module or ""


def rooms_imported(path: Path) -> set[str]:
    """The rooms that a module imports from."""
    parts = (name.split(".") for name in imports(path))
    return {name[1] for name in parts if name[0] == "jaxfit" and len(name) > 1}


def test_every_room_has_its_place() -> None:
    assert {room_of(path) for path in MODULES} - {""} == set(ROOMS)


def test_imports_point_upward() -> None:
    for path in MODULES:
        room = room_of(path)
        later = ROOMS[ROOMS.index(room) + 1 :] if room else ()
        wrong = rooms_imported(path) & set(later)
        assert not wrong, f"{path} is in {room}, which lies before {', '.join(sorted(wrong))}"


def test_modules_do_not_import_one_another_in_a_circle() -> None:
    names = {".".join(("jaxfit", *path.relative_to(PACKAGE).with_suffix("").parts)): path for path in MODULES}
    edges = {name: {other for other in imports(path) if other in names} for name, path in names.items()}
    done: set[str] = set()
    while free := {name for name in edges if name not in done and edges[name] <= done}:
        done |= free
    assert done == set(edges), f"a circle among {', '.join(sorted(set(edges) - done))}"


@pytest.mark.parametrize("room", PURE)
def test_pure_rooms_know_neither_opencv_nor_files(room: str) -> None:
    for path in (PACKAGE / room).rglob("*.py"):
        assert not {"cv2", "pathlib", "tqdm"} & {name.partition(".")[0] for name in imports(path)}, path


def test_every_module_says_what_it_is_for() -> None:
    for path in MODULES:
        first = (ast.get_docstring(parsed(path)) or "").partition("\n")[0]
        assert len(first) > 15, f"{path}: expected a first line that says what it is for"


def test_nothing_outside_shapes_asks_for_a_class_of_space() -> None:
    for path in MODULES:
        if room_of(path) != "shapes":
            assert not re.search(r"isinstance\([^)]*CameraASM", path.read_text(encoding="utf-8")), path


if __name__ == "__main__":
    for room in ROOMS:
        files = [path for path in MODULES if room_of(path) == room]
        lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)
        from_rooms = set().union(*(rooms_imported(path) for path in files)) - {room}
        print(f"{room:14} {len(files):3} files {lines:5} lines  <- {', '.join(r for r in ROOMS if r in from_rooms)}")
