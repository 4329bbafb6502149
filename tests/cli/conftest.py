"""Small labelled pictures that any machine can make, and a model trained on them."""

from pathlib import Path

import numpy as np
import pytest
from drawing import TRAIN, draw_face

from jaxfit.cli.main import main
from jaxfit.data.images import write_image
from jaxfit.data.pts import write_pts


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 24 drawn faces with ``.pts`` labels."""
    folder = tmp_path_factory.mktemp("drawn")
    rng = np.random.default_rng(0)
    for number in range(24):
        picture, points = draw_face(rng)
        write_image(folder / f"face{number:03}.png", picture)
        write_pts(folder / f"face{number:03}.pts", points)
    return folder


@pytest.fixture(scope="session")
def model(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model file trained by the command on the drawn faces."""
    path = tmp_path_factory.mktemp("model") / "blobs.safetensors"
    assert main(["train", "--data", f"pts:{drawn}", "--out", str(path), *TRAIN]) == 0
    return path
