"""Time the stages of a fit on the cores that this process may use, beside what the machine can do.

GB/s count what a stage has to read and write at least: crops in and maps out; looked-up values in and descriptors out;
descriptors and weights in and steps out. GFLOP/s count two for each multiply-add of the linear map. Stages are timed
alone; in a fit they are compiled together, so that their shares need not add up to 1.
"""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from report import Report, cores, measure, script_parser
from timing import computed, median_seconds

import jaxfit
from jaxfit.cascade.fit import fit_crops
from jaxfit.cascade.model import Cascade, Regressor
from jaxfit.cascade.starts import starts_of
from jaxfit.cascade.state import State, advanced, features_of, state_of
from jaxfit.descriptors import dense, sift
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.errors import InputError

SIDE = 2048  # of the matrices whose product measures what the machine can compute
COPIED = 2**28  # bytes, far more than caches hold
FLOAT = 4  # bytes
COLUMNS = {
    "model": "",
    "stage": "",
    "times a fit": "d",
    "µs a face": ".1f",
    "of the fit": ".0%",
    "GFLOP/s": ".1f",
    "of the machine's GFLOP/s": ".0%",
    "GB/s": ".1f",
    "of the machine's GB/s": ".0%",
}


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("models", nargs="+", metavar="MODEL", help="model files or names of bundled models")
    parser.add_argument("--batch", type=int, default=256, help="faces at once")
    parser.add_argument("--repetitions", type=int, default=9, help="of each measurement; the median counts")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    if min(arguments.batch, arguments.repetitions) < 1:
        raise InputError(
            f"expected a batch and repetitions of 1 or more; got {arguments.batch} and {arguments.repetitions}"
        )

    def seconds(function: Callable[..., Any], *inputs: Any) -> float:
        return median_seconds(computed(function, *inputs), arguments.repetitions)

    flops, bandwidth = machine_flops(seconds), machine_bandwidth(seconds)
    rows: list[dict[str, Any]] = [
        {"model": "the machine", "stage": f"product of {SIDE}² matrices", "GFLOP/s": flops / 1e9},
        {"model": "the machine", "stage": f"reading and writing {COPIED // 2**20} MiB", "GB/s": bandwidth / 1e9},
    ]
    for name in arguments.models:
        rows += [
            {"model": Path(name).stem, **row} for row in stages(jaxfit.load(name).cascade, arguments.batch, seconds)
        ]
    for row in rows:
        row["of the machine's GFLOP/s"] = row["GFLOP/s"] * 1e9 / flops if "GFLOP/s" in row else None
        row["of the machine's GB/s"] = row["GB/s"] * 1e9 / bandwidth if "GB/s" in row else None
    about = (
        f"Stages of a fit, {arguments.batch} faces at once, on {cores()} core{'' if cores() == 1 else 's'}, warm, "
        f"median of {arguments.repetitions}."
    )
    report.table(rows, COLUMNS, above=about)


def stages(cascade: Cascade, faces: int, seconds: Callable[..., float]) -> list[dict[str, Any]]:
    """A row for each stage of fitting ``faces`` crops of noise from the mean face, and one for all of them as one."""
    descriptor, space, side = cascade.descriptor, cascade.space, cascade.frame.crop
    crops = jnp.asarray(np.random.default_rng(0).integers(0, 256, (faces, side, side)), jnp.uint8)
    starts = starts_of(space, cascade.frame, jnp.zeros(1))
    one = jax.vmap(lambda start: state_of(descriptor, space, space.place(start)))(starts)
    states = jax.tree.map(lambda part: jnp.broadcast_to(part, (faces, *part.shape)), one)
    steps = len(cascade.windows)
    landmarks = len(cascade.weights[0]) // descriptor.size

    prepare = jax.jit(jax.vmap(descriptor.prepare))
    prepared = prepare(crops)

    @jax.jit
    def describe(prepared: Any, states: State, window: jax.Array) -> jax.Array:
        return features_of(descriptor, space, prepared, states, window)

    @jax.jit
    def regress(features: jax.Array, regressors: list[Regressor]) -> list[jax.Array]:
        # All steps: the weights of a single one would stay in the cache.
        return [regressor.predict(features) for regressor in regressors]

    @jax.jit
    def move(states: State, step: jax.Array) -> State:
        return jax.vmap(jax.vmap(partial(advanced, descriptor, space)))(states, step)

    regressors = [cascade.regressor(step) for step in range(steps)]
    features = describe(prepared, states, cascade.windows[0])
    found = regress(features, regressors)
    numbers = sum(leaf.size for leaf in jax.tree.leaves(regressors))

    whole = seconds(fit_crops, cascade, crops)
    took = {
        "maps": seconds(prepare, crops),
        # Each step has its own window, and windows of other sizes are looked up in other places.
        "describing": sum(seconds(describe, prepared, states, window) for window in cascade.windows),
        "linear map": seconds(regress, features, regressors),
        "moving": seconds(move, states, found[0]) * steps,
    }
    moved = {
        "maps": crops.nbytes + sum(leaf.nbytes for leaf in jax.tree.leaves(prepared)),
        "describing": steps * faces * landmarks * (looked_up(descriptor) + descriptor.size) * FLOAT,
        "linear map": (steps * (features.size + found[0].size) + numbers) * FLOAT,
    }
    rows = []
    for stage, duration in took.items():
        row = {"stage": stage, "times a fit": 1 if stage == "maps" else steps, "of the fit": duration / whole}
        if stage in moved:
            row["GB/s"] = moved[stage] / duration / 1e9
        if stage == "linear map":
            row["GFLOP/s"] = 2 * faces * numbers / duration / 1e9
        rows.append({**row, "µs a face": 1e6 * duration / faces})
    return [*rows, {"stage": "the fit", "times a fit": 1, "µs a face": 1e6 * whole / faces, "of the fit": 1.0}]


def looked_up(descriptor: Descriptor) -> int:
    """How many numbers one landmark's descriptor interpolates between."""
    if isinstance(descriptor, dense.Dense):
        return dense.CELLS**2 * dense.BINS * 4
    # Of a window's principal orientation there is another, upright one.
    windows = 2 if isinstance(descriptor, sift.Sift) and descriptor.orientation == "principal" else 1
    return windows * (sift.SAMPLES + 2) ** 2 * 4


def machine_flops(seconds: Callable[..., float]) -> float:
    """Operations a second in the product of two large matrices."""
    matrix = jnp.asarray(np.random.default_rng(0).normal(size=(SIDE, SIDE)), jnp.float32)
    return 2 * SIDE**3 / seconds(jax.jit(jnp.matmul), matrix, matrix)


def machine_bandwidth(seconds: Callable[..., float]) -> float:
    """Bytes read and written a second in a pass over memory."""
    # In place: otherwise the pages of new memory would be what is measured.
    add_one = jax.jit(lambda numbers: numbers + 1.0, donate_argnums=0)
    numbers = [jnp.zeros(COPIED // FLOAT, jnp.float32)]

    def once_more() -> jax.Array:
        numbers[0] = add_one(numbers[0])
        return numbers[0]

    return 2 * COPIED / seconds(once_more)


if __name__ == "__main__":
    sys.exit(main())
