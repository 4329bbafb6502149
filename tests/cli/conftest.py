"""Small labelled pictures that any machine can make, and a model trained on them."""

from pathlib import Path

import pytest
from drawing import TRAIN, draw_faces

from jaxfit.cli.main import main


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 24 drawn faces with ``.pts`` labels."""
    return draw_faces(tmp_path_factory.mktemp("drawn"), 24)


@pytest.fixture(scope="session")
def model(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model file trained by the command on the drawn faces."""
    path = tmp_path_factory.mktemp("model") / "blobs.safetensors"
    assert main(["train", "--data", f"pts:{drawn}", "--out", str(path), *TRAIN]) == 0
    return path
