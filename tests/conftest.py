"""What all tests share: array shapes checked, workers, models of heads; real data and a browser if at hand."""

import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

if TYPE_CHECKING:
    from jaxfit.labels.records import Dataset

# Compilation and slow disks are no failures.
settings.register_profile("jaxfit", deadline=None)
settings.load_profile("jaxfit")

# Before any import of jaxfit: functions are checked as they are defined.
install_import_hook("jaxfit", "beartype.beartype")


# What starts processes, a browser or notebooks, or trains whole models: left out of `make check`.
SLOW_FOLDERS = {"cli", "experiments", "learning", "runs", "scripts", "serving"}
SLOW_FILES = {"test_contributing", "test_notebooks", "test_packages", "test_readme", "test_site"}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest file comes first, so that no worker is left with it alone at the end."""
    items.sort(key=lambda item: item.path.stem != "test_readme")
    for item in items:
        if item.path.parent.name in SLOW_FOLDERS or item.path.stem in SLOW_FILES:
            item.add_marker("slow")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the development data in ../shared/data")
    return folder


@pytest.fixture(scope="session")
def real_dataset(shared_data: Path) -> Callable[[str], "Dataset"]:
    """Reads the dataset ``FORMAT:PATH``, its path being one in the real data; each is read once."""
    from jaxfit.labels.datasets import read_dataset

    @cache
    def read(spec: str) -> "Dataset":
        name, path = spec.split(":")
        return read_dataset(f"{name}:{shared_data / path}")

    return read


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 24 drawn faces with ``.pts`` labels."""
    from drawn_faces import draw_faces

    return draw_faces(tmp_path_factory.mktemp("drawn"), 24)


@pytest.fixture(scope="session")
def drawn_model(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a model that is trained on the drawn faces."""
    from drawn_faces import OPTIONS

    from jaxfit.labels.datasets import read_dataset
    from jaxfit.learning.train import train
    from jaxfit.models.files import save

    path = tmp_path_factory.mktemp("model") / "blobs.safetensors"
    found = read_dataset(f"pts:{drawn}")
    save(train(found.faces, found.scheme, options=OPTIONS).model, path)
    return path


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
def browser() -> Iterator[Any]:
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
