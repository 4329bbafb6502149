"""Several devices, here the processor taken for two: the same fits as one device makes."""

import subprocess
import sys
from pathlib import Path

import jaxfit

# Pictures of noise will do: what is found in them must not depend on devices. 3D alignment solves systems in batches,
# for which two devices once waited forever.
FIT = """
import sys
from importlib import import_module
sys.path[:0] = sys.argv[1:]
import jax, numpy as np
jax.config.update("jax_num_cpu_devices", 2)
import jaxfit
from small import random_model
batches, stream = (import_module(f"jaxfit.fitting.{name}") for name in ("batches", "stream"))
batches.BATCHES = (16,)
assert batches.batch_sizes() == (32, 16)

used, find = [], batches._find
def remembering(*given):
    found = find(*given)
    used.append(sorted(device.id for device in found["landmarks"].devices()))
    return found
batches._find = remembering

def fits():
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (90, 90), dtype=np.uint8) for _ in range(48)]
    with jax.default_device(jax.local_devices()[1]):
        return jaxfit.fit(model, pictures, np.tile([15.0, 15.0, 60.0, 60.0], (48, 1)))

model = random_model("alignment3d")
together = fits()
assert sorted(used) == [[0, 1], [1]], used  # the last batch where the caller says, though in a thread
batches.batch_sizes = stream.batch_sizes = lambda: (16,)
alone = fits()
assert used[2:] == [[1]] * 3, used
assert together.ok.all()
assert len(np.unique(together.landmarks[:, 0, 0])) == 48
for name, values in alone.arrays.items():
    np.testing.assert_allclose(together.arrays[name], values, atol=1e-3)
"""


def test_devices_share_the_work_and_find_the_same() -> None:
    folders = [str(Path(jaxfit.__file__).parents[1]), str(Path(__file__).parent)]
    child = subprocess.run([sys.executable, "-c", FIT, *folders], capture_output=True, text=True, timeout=600)
    assert child.returncode == 0, child.stderr
