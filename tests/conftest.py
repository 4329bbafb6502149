"""What all tests share: array shapes checked, workers, models of heads; real data and a browser if at hand."""

import shutil
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
    from jaxfit.labels.datasets import read_dataset

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


@pytest.fixture(scope="module")
def browser() -> Iterator:
    """Chromium, with a camera that sees a test card; once a module, for its event loop runs until it is closed."""
    api = pytest.importorskip("playwright.sync_api")
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip("needs Chromium or Chrome")
    options = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-dev-shm-usage"]
    options += ["--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"]
    with api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=path, args=options)
        yield running
        running.close()


@pytest.fixture(autouse=True, scope="session")
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Commands keep their compiled code in a folder of the tests' own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield
