"""What tests of fitting share: a portrait with one face."""

import numpy as np
import pytest

import jaxfit


@pytest.fixture(scope="session")
def portrait() -> np.ndarray:
    """The picture of one person that matplotlib ships."""
    cbook = pytest.importorskip("matplotlib.cbook")
    return jaxfit.read_image(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))
