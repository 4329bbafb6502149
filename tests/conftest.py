"""What all tests share: array shapes checked, workers, models of heads; real data and a browser if at hand."""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
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


# What starts processes, a browser or notebooks, trains models or compiles much: left out of `make check`.
SLOW_FOLDERS = {"cli", "experiments", "learning", "runs", "scripts", "serving"}
SLOW_FILES = {
    *("test_contributing", "test_modes", "test_notebooks", "test_packages", "test_readme", "test_site"),
    *("test_cascade", "test_confidence", "test_greedy", "test_regression", "test_tuning"),
    *("test_devices", "test_export", "test_find", "test_fit", "test_stream", "test_track", "test_unshift"),
    *(
        "test_alignment",
        "test_camera_asm",
        "test_head_pose",
        "test_with_heads",
        "test_place",
        "test_dense",
        "test_disturb",
        "test_sift_laws",
    ),
    *("test_bundled_3d", "test_parametric68", "test_conversions", "test_lifting"),
    *("test_datasets", "test_detectors", "test_evaluate", "test_plots", "test_turned"),
    *("test_aflw", "test_aflw2000", "test_pointing04", "test_head_models"),
}
# What runs all commands of the documents, trains or exports many models, or measures: left out of `make test`, too.
LONG_FOLDERS = {"scripts"}
LONG_FILES = {
    *("test_notebooks", "test_readme", "test_site", "test_modes"),
    *("test_cascade", "test_tuning", "test_finetune", "test_learn_confidence", "test_experiments", "test_choose"),
    *("test_collect", "test_evaluate_command", "test_finetune_command", "test_train_command", "test_processes"),
    *("test_bundled_3d", "test_parametric68", "test_export", "test_endurance", "test_faults", "test_twins"),
}


def pytest_configure(config: pytest.Config) -> None:
    """Compiling takes most of the time: less well, and once for all workers, their processes and later runs."""
    compiled = Path(config.rootpath) / ".pytest_cache" / "compiled"
    settings: dict[str, Any] = {
        "jax_compilation_cache_dir": str(compiled),
        "jax_persistent_cache_min_compile_time_secs": 0.2,
        "jax_disable_most_optimizations": True,
    }
    for name, value in settings.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest file comes first, so that no worker is left with it alone at the end."""
    items.sort(key=lambda item: item.path.stem != "test_readme")
    for item in items:
        folder, file = item.path.parent.name, item.path.stem
        if folder in LONG_FOLDERS or file in LONG_FILES:
            item.add_marker("long")
        if folder in SLOW_FOLDERS or file in SLOW_FILES or file in LONG_FILES:
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
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """A file that all workers share, made by the first who asks for it."""
    base = tmp_path_factory.getbasetemp()
    folder = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def path_of(name: str, make: Callable[[Path], None]) -> Path:
        path = folder / name
        with (folder / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                make(path)
        return path

    return path_of


@pytest.fixture(scope="session")
def drawn_model(drawn: Path, made_once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """The file of a model that is trained on the drawn faces."""
    from drawn_faces import OPTIONS

    from jaxfit.labels.datasets import read_dataset
    from jaxfit.learning.train import train
    from jaxfit.models.files import save

    def make(path: Path) -> None:
        found = read_dataset(f"pts:{drawn}")
        save(train(found.faces, found.scheme, options=OPTIONS).model, path)

    return made_once("blobs.safetensors", make)


@pytest.fixture(scope="session")
def heads(tmp_path_factory: pytest.TempPathFactory) -> tuple:
    """The records of 32 drawn heads, and their pictures."""
    from drawn_heads import draw_heads

    return draw_heads(tmp_path_factory.mktemp("heads"), 32)


@pytest.fixture(scope="session")
def head_models(heads: tuple, made_once: Callable[[str, Callable[[Path], None]], Path]) -> dict:
    """A model of each 3D method, trained on the drawn heads."""
    from drawn_heads import train_heads

    from jaxfit.models.files import load, save

    def make(path: Path) -> None:
        save(train_heads(heads, path.stem), path)

    return {method: load(made_once(f"{method}.safetensors", make)) for method in ("alignment3d", "regression3d")}


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
