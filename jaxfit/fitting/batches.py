"""The second half of the stream: in which batches faces are computed, compiled for few sizes, on all devices."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jaxfit.cascade.confidence import Confidence
from jaxfit.cascade.fit import find
from jaxfit.cascade.model import Cascade
from jaxfit.cascade.uncertainty import Uncertainty
from jaxfit.data.threads import cores, reading_threads
from jaxfit.fitting.pipeline import Pipeline
from jaxfit.modes import computing
from jaxfit.shapes.space import ShapeSpace3D

# Any number of faces is served by batches of these sizes, so that there are three compilations. Where there are several
# devices there is one more: batches of the first size for each of them, all at once.
BATCHES = (64, 8, 1)
_MOST_AT_ONCE = 8  # batches that are computed at once; each holds a batch and its descriptors


def batch_sizes() -> tuple[int, ...]:
    """Sizes of batches, large ones first."""
    several = len(jax.local_devices())
    return BATCHES if several == 1 else (several * BATCHES[0], *BATCHES)


def batches_of(count: int) -> list[int]:
    """The sizes of the batches in which ``count`` faces are fitted, large ones first.

    Several batches are computed at once: a single device takes large ones only where there is one for every thread.
    """
    least = least_batches(count)
    sizes: list[int] = []
    for size in batch_sizes():
        if size == 1 or count // size >= least:
            sizes += [size] * (count // size)
            count %= size
    return sizes


def least_batches(count: int) -> int:
    """How many batches of a size there must be among ``count`` faces for it to be used."""
    return reading_threads(count) if len(jax.local_devices()) == 1 else 1


def computed_at_once() -> int:
    """How many batches are computed at the same time.

    Much of a computation keeps to one core, so that each core has its own; an accelerator computes one while the next
    is on its way to it. Batches that are shared out to several devices keep all of them busy.
    """
    if len(jax.local_devices()) > 1:
        return 1
    return min(_MOST_AT_ONCE, cores()) if jax.default_backend() == "cpu" else 2


def batch_computation(pipeline: Pipeline) -> Callable[[np.ndarray], dict[str, jax.Array]]:
    """What finds, in crops (N, side, side), all that is in `Fits`, by name, in crop pixels; it works in the background.

    Batches that are larger than one device's are shared out to all devices, and the model with them.
    """
    model, rotations, passes = pipeline.model, pipeline.starts.rotations, pipeline.passes
    parts = model.cascade, model.aligned, model.confidence, model.uncertainty

    @cache  # which takes time and memory: only where there is such a batch
    def everywhere() -> Any:
        return jax.device_put(parts, NamedSharding(_mesh(), PartitionSpec()))

    def compute(crops: np.ndarray) -> dict[str, jax.Array]:
        if len(crops) <= BATCHES[0]:
            return _find(*parts, crops, rotations, passes, None)
        shared = jax.device_put(crops, NamedSharding(_mesh(), PartitionSpec("faces")))
        return _find(*everywhere(), shared, rotations, passes, _mesh())

    return compute


def _mesh() -> Mesh:
    """This process's devices."""
    devices = jax.local_devices()
    return jax.make_mesh((len(devices),), ("faces",), (AxisType.Auto,), devices=devices)


@partial(jax.jit, static_argnames=("passes", "mesh"))
def _find(
    cascade: Cascade,
    aligned: ShapeSpace3D | None,
    confidence: Confidence | None,
    uncertainty: Uncertainty | None,
    crops: jax.Array,
    rotations: jax.Array,
    passes: int,
    mesh: Mesh | None,
) -> dict[str, jax.Array]:
    """What is found in crops; by each device of the mesh in its share of them."""

    def of_share(
        cascade: Cascade,
        aligned: ShapeSpace3D | None,
        confidence: Confidence | None,
        uncertainty: Uncertainty | None,
        rotations: jax.Array,
        crops: jax.Array,
    ) -> dict:
        return find(cascade, aligned, crops, rotations, passes, confidence, uncertainty)

    if mesh is not None:
        everything, faces = PartitionSpec(), PartitionSpec("faces")
        of_share = jax.shard_map(
            of_share,
            mesh=mesh,
            in_specs=(everything, everything, everything, everything, everything, faces),
            out_specs=faces,
            check_vma=False,  # loops begin with constants, which all devices share
        )
    return of_share(cascade, aligned, confidence, uncertainty, rotations, crops)


@computing
def compile_batches(pipeline: Pipeline, sizes: Sequence[int]) -> None:
    """Compile what fits batches of these sizes."""
    compute, side = batch_computation(pipeline), pipeline.model.cascade.frame.crop
    for size in sizes:
        jax.block_until_ready(compute(np.zeros((size, side, side), np.uint8)))
