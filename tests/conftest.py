"""What all tests share: array shapes checked at run time, workers, real data where it is at hand, models of heads."""

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# Compilation and slow disks are no failures.
settings.register_profile("jaxfit", deadline=None)
settings.load_profile("jaxfit")

# Before any import of jaxfit: functions are checked as they are defined.
install_import_hook("jaxfit", "beartype.beartype")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest file comes first, lest one of several workers be left with it alone."""
    items.sort(key=lambda item: item.path.stem != "test_readme")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the development data in ../shared/data")
    return folder


@pytest.fixture(scope="session")
def real_dataset(shared_data: Path) -> Callable:
    """Reads the dataset ``FORMAT:PATH``, its path being one in the real data; each is read once."""
    from jaxfit.data.datasets import read_dataset

    @cache
    def read(spec: str):
        name, path = spec.split(":")
        return read_dataset(f"{name}:{shared_data / path}")

    return read


@pytest.fixture(scope="session")
def heads(tmp_path_factory: pytest.TempPathFactory) -> tuple:
    """The records of 32 drawn heads, and their pictures."""
    from drawn_heads import draw_heads

    return draw_heads(tmp_path_factory.mktemp("heads"), 32)


@pytest.fixture(scope="session")
def head_models(heads: tuple) -> dict:
    """A model of each 3D method, trained on the drawn heads."""
    from drawn_heads import train_heads

    return train_heads(heads)


@pytest.fixture(autouse=True, scope="session")
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Commands keep their compiled code in a folder of the tests' own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield
