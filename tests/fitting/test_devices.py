"""Several devices, here the processor taken for two: the same fits as one device makes, in any number."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxfit.models.files import bundled

# Pictures of noise will do: what is found in them must not depend on devices.
FIT = """
import sys
import jax, numpy as np
name, devices, target = sys.argv[1], int(sys.argv[2]), sys.argv[3]
jax.config.update("jax_num_cpu_devices", devices)
import jaxfit
from jaxfit import fitting
from jaxfit.fitting.stream import batch_sizes
# Large batches whatever the number of threads: those of other sizes are rounded differently.
fitting.reading_threads = lambda count: 1
assert batch_sizes()[0] == 64 * devices
rng = np.random.default_rng(0)
pictures = [rng.integers(0, 256, (90, 90), dtype=np.uint8) for _ in range(138)]
fits = jaxfit.fit(jaxfit.load(name), pictures, np.tile([15.0, 15.0, 60.0, 60.0], (138, 1)))
assert len(jax.local_devices()) == devices and fits.ok.all()
np.save(target, fits.landmarks if fits.landmarks_3d is None else fits.landmarks_3d)
# Few faces are computed where the caller says, though in threads.
used, find = set(), fitting._find
def seen(*given):
    found = find(*given)
    used.update(*(of.devices() for of in found.values()))
    return found
fitting._find = seen
with jax.default_device(jax.local_devices()[-1]):
    jaxfit.fit(jaxfit.load(name), pictures[:3], np.tile([15.0, 15.0, 60.0, 60.0], (3, 1)))
assert used == {jax.local_devices()[-1]}, used
"""


# 3D alignment solves systems in batches, for which two devices once waited forever.
@pytest.mark.parametrize("name", ["sdm68", "alignment68-3d"])
def test_devices_share_the_work_and_find_the_same(name: str, tmp_path: Path) -> None:
    assert name in bundled()
    found = []
    for devices in (1, 2):
        target = tmp_path / f"{devices}.npy"
        subprocess.run([sys.executable, "-c", FIT, name, str(devices), str(target)], check=True, timeout=300)
        found.append(np.load(target))
    np.testing.assert_allclose(found[1], found[0], atol=1e-3)
