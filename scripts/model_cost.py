"""Size and cost of one cascade step by method and number of points (thesis 3.2.1)."""

import argparse
import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from report import Report, measure, script_parser
from timing import computed, median_seconds

from jaxfit.cascade.state import State, advanced, features_of, state_of
from jaxfit.data.boxes import bounding_square
from jaxfit.descriptors.descriptor import Descriptor
from jaxfit.labels.datasets import read_datasets
from jaxfit.learning.methods import METHODS, Options
from jaxfit.shapes.space import ShapeSpace, Start

FACES, REPETITIONS = 64, 9
COLUMNS = {
    "points": "d",
    "method": "",
    "state": "d",
    "parameters": "d",
    "multiply-adds": "d",
    "regression µs": ".0f",
    "descriptors µs": ".0f",
    "step µs": ".0f",
}


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument(
        "--data", nargs="+", required=True, metavar="SPEC", help="one dataset for each number of points"
    )
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    rows = []
    for dataset in read_datasets(arguments.data, None):
        faces = np.stack([face.landmarks for face in dataset.faces if face.complete])
        squares = np.stack([bounding_square(points) for points in faces])
        relative = (faces - squares[:, None, :2]) / squares[:, None, 2:]
        for name, method in METHODS.items():
            # Alignment comes after the last step; up to there it is the parametric method.
            if not method.aligns:
                space = method.learn_space(relative, dataset.scheme, Options(), method.descriptor.frame.face)
                rows.append({"points": faces.shape[1], "method": name, **cost(space, method.descriptor)})
    report.table(rows, COLUMNS, above=f"One step of one face; {FACES} faces a batch, median of {REPETITIONS}.")


def cost(space: ShapeSpace, descriptor: Descriptor) -> dict[str, object]:
    frame = descriptor.frame
    middle = Start(jnp.full(2, frame.middle), jnp.ones(()), jnp.float32(0.1))
    state = state_of(descriptor, space, space.place(middle))
    points = space.landmarks(state.params).shape[0]
    features = points * descriptor.size
    rng = np.random.default_rng(0)
    weights = jnp.asarray(rng.normal(0, 1e-4, (features, space.size)), jnp.float32)
    crops = jnp.asarray(rng.integers(0, 256, (FACES, frame.crop, frame.crop)), jnp.uint8)
    states = jax.tree.map(lambda part: jnp.broadcast_to(part, (FACES, 1, *part.shape)), state)
    prepared = jax.jit(jax.vmap(descriptor.prepare))(crops)
    window = jnp.float32(0.25 * frame.face)

    def describe(prepared: Any, states: State) -> jax.Array:
        return features_of(descriptor, space, prepared, states, window)

    def regress(found: jax.Array, states: State) -> State:
        return jax.vmap(jax.vmap(partial(advanced, descriptor, space)))(states, found @ weights)

    batched = jax.jit(describe)
    step = jax.jit(lambda prepared, states: regress(describe(prepared, states), states))
    found = batched(prepared, states)
    # From parameters to landmarks, as compiled: nothing for SDM, whose parameters are the landmarks.
    geometry = (jax.jit(space.landmarks).lower(state.params).compile().cost_analysis() or {}).get("flops", 0)
    return {
        "state": space.size,
        "parameters": (features + 1) * space.size,
        "multiply-adds": features * space.size + int(geometry / 2),
        "regression µs": microseconds(jax.jit(regress), found, states),
        "descriptors µs": microseconds(batched, prepared, states),
        "step µs": microseconds(step, prepared, states),
    }


def microseconds(function: Any, *inputs: Any) -> float:
    return median_seconds(computed(function, *inputs), REPETITIONS) / FACES * 1e6


if __name__ == "__main__":
    sys.exit(main())
