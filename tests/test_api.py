"""The API reference says what the code says, of everything that is public."""

import importlib
from pathlib import Path

import pytest

import jaxfit

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def build():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "scripts"))
        yield importlib.import_module("build_api")


def test_every_public_name_has_its_place(build) -> None:
    listed = [name for names in build.GROUPS.values() for name in names]
    assert sorted(listed) == sorted(jaxfit.__all__)


def test_every_public_name_is_described() -> None:
    for name in jaxfit.__all__:
        assert (getattr(jaxfit, name).__doc__ or "").strip(), name


def test_sections_become_lists(build) -> None:
    told = "\n\n".join(
        build._described(
            "Do it.\n\nArgs:\n    one: the first,\n        and more.\n    two: last.\n\nReturns:\n    A ``thing``."
        )
    )
    assert told == "Do it.\n\n*Args*\n\n- `one`: the first, and more.\n- `two`: last.\n\n*Returns* A `thing`."


def test_the_page_is_up_to_date(build) -> None:
    # Types are checked at run time in tests, which changes signatures: names and descriptions are compared.
    page, made = ((build.API).read_text(encoding="utf-8"), build.reference())
    assert [line for line in page.splitlines() if line.startswith(("#", "- `", "*"))] == [
        line for line in made.splitlines() if line.startswith(("#", "- `", "*"))
    ], "run python scripts/build_api.py"
