"""The API reference says what the code says, of everything that is public."""

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
        yield importlib.import_module("build_api")


def test_every_namespace_has_its_place(build: ModuleType) -> None:
    named = {name for name in jaxfit.__all__ if inspect.ismodule(getattr(jaxfit, name))}
    assert named <= set(build.NAMESPACES)
    rooms = {found.name for found in pkgutil.iter_modules(jaxfit.__path__) if found.ispkg}
    # Rooms below the public ones, and the commands.
    assert rooms - set(build.NAMESPACES) == {"cli", "descriptors", "image", "shapes"}


def test_every_public_name_is_listed_and_described_once(build: ModuleType) -> None:
    contents, _, entries = build.reference().partition("## The top level")
    modules = build.modules()
    lines = {line.partition("**: ")[0].removeprefix("- **"): line for line in contents.splitlines()}
    public = set()
    for path, module in modules.items():
        names = build.public_names(module)
        if hasattr(module, "__all__"):
            assert set(names) == {name for name in module.__all__ if not inspect.ismodule(getattr(module, name))}
        assert all(f"[`{name}`](#" in lines[path] for name in names)
        public |= {id(getattr(module, name)) for name in names}
    headings = [line.removeprefix("### ").rpartition(".") for line in entries.splitlines() if line.startswith("### ")]
    described = [id(getattr(modules[path], name)) for path, _, name in headings]
    assert sorted(described) == sorted(public)


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


def test_the_page_is_up_to_date(build: ModuleType) -> None:
    # Types are checked at run time in tests, which changes signatures: names and descriptions are compared.
    page, made = ((build.API).read_text(encoding="utf-8"), build.reference())
    assert [line for line in page.splitlines() if line.startswith(("#", "- `", "*"))] == [
        line for line in made.splitlines() if line.startswith(("#", "- `", "*"))
    ], "run python scripts/build_api.py"
