"""The reference says what the code says, of all public names and all commands."""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import jaxfit

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def build() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "scripts"))
        yield importlib.import_module("build_reference")


def test_every_namespace_has_its_place(build: ModuleType) -> None:
    named = {name for name in jaxfit.__all__ if inspect.ismodule(getattr(jaxfit, name))}
    assert named <= set(build.NAMESPACES)
    rooms = {found.name for found in pkgutil.iter_modules(jaxfit.__path__) if found.ispkg}
    # Rooms below the public ones, and the commands.
    assert rooms - set(build.NAMESPACES) == {"cli", "descriptors", "image", "shapes"}


def test_every_public_name_is_listed_and_described_once(build: ModuleType) -> None:
    pages = build.api_pages()
    modules = build.modules()
    public, described = set(), []
    for path, module in modules.items():
        names, page = build.public_names(module), pages[f"api/{path}.md"]
        if hasattr(module, "__all__"):
            assert set(names) == {name for name in module.__all__ if not inspect.ismodule(getattr(module, name))}
        assert all(f"[`{name}`](" in page and f"[`{name}`](" in pages["api/index.md"] for name in names)
        assert f"[{path}]({path}.md)" in pages["api/index.md"]
        public |= {id(getattr(module, name)) for name in names}
        headings = [line.removeprefix("## ") for line in page.splitlines() if line.startswith("## ")]
        described += [id(getattr(module, name)) for name in headings]
    assert sorted(described) == sorted(public)


def test_every_command_and_option_is_described(build: ModuleType) -> None:
    page = build.commands_page()
    commands = ["fit", "track", "train", "experiments run", "models"]
    assert all(f"\n## jaxfit {command}\n" in page for command in commands)
    assert "`--any-rotation`: " in page
    assert "(default: face68)" in page
    assert "%(" not in page
    assert build._plain("points<N> of 'a/*.jpg'") == r"points\<N\> of 'a/\*.jpg'"


def test_every_public_name_says_what_it_is_for(build: ModuleType) -> None:
    for path, module in build.modules().items():
        assert (module.__doc__ or "").strip(), path
        for name in build.public_names(module):
            assert build.description(name, getattr(module, name)).strip(), f"{path}.{name}"


def test_sections_become_lists(build: ModuleType) -> None:
    text = "\n\n".join(
        build._described(
            "Do it.\n\nArgs:\n    one: the first,\n        and more.\n    two: last.\n\nReturns:\n    A ``thing``."
        )
    )
    assert text == "Do it.\n\n*Args*\n\n- `one`: the first, and more.\n- `two`: last.\n\n*Returns* A `thing`."


def test_pages_that_have_not_changed_are_left_alone(build: ModuleType, tmp_path: Path) -> None:
    build.write_reference(tmp_path)
    written = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.md")}
    assert {path.name for path in written} >= {"commands.md", "index.md", "jaxfit.md", "jaxfit.data.md"}
    build.write_reference(tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.md")} == written
