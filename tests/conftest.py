"""What all tests share: array shapes checked at run time, and the real data where it is at hand."""

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# Before any import of jaxfit: functions are checked as they are defined.
install_import_hook("jaxfit", "beartype.beartype")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the development data in ../shared/data")
    return folder
