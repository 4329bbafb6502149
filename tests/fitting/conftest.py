"""What tests of fitting share: a portrait with one face, and compiling that is over sooner."""

from collections.abc import Iterator

import jax
import numpy as np
import pytest

import jaxfit


@pytest.fixture(scope="session")
def portrait() -> np.ndarray:
    """The picture of one person that matplotlib ships."""
    cbook = pytest.importorskip("matplotlib.cbook")
    return jaxfit.read_image(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))


@pytest.fixture(scope="module")
def compiled_sooner() -> Iterator[None]:
    """Compiling takes most of the time: less well, and sooner."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
