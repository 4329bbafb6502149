"""What all tests share: array shapes checked at run time, and the real data where it is at hand."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# Compilation and slow disks are no failures.
settings.register_profile("jaxfit", deadline=None)
settings.load_profile("jaxfit")

# Before any import of jaxfit: functions are checked as they are defined.
install_import_hook("jaxfit", "beartype.beartype")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the development data in ../shared/data")
    return folder


@pytest.fixture(autouse=True, scope="session")
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Commands keep their compiled code in a folder of the tests' own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield
