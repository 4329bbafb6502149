"""How well 3D alignment recovers shape and pose from landmarks with errors, on random heads of the head model."""

import argparse
import sys
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from report import Report, measure, script_parser
from scipy.spatial.transform import Rotation
from timing import computed, median_seconds

from jaxfit.cli.arguments import add_head_model, seed
from jaxfit.errors import InputError
from jaxfit.heads.model import load_head_model
from jaxfit.schemes.known import SCHEMES, scheme_named
from jaxfit.shapes.alignment import Alignment, align_head, refine_head
from jaxfit.shapes.camera import rotation_matrix

FACE = 120.0  # side of the mean face, in pixels
NOISES = (0.0, 0.5, 1.0, 2.0, 4.0)  # standard deviations of the landmarks' errors in x and y, in pixels of such a face
MOST = {"roll": 40.0, "pitch": 40.0, "yaw": 60.0}  # degrees to either side
COLUMNS = {
    "noise px": "g",
    "solver": "",
    "pose median °": ".3f",
    "pose 95 % °": ".3f",
    "shape median %": ".2f",
    "shape 95 % %": ".2f",
    "rounds": ".0f",
    "ms/face": ".2f",
}


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("--scheme", choices=SCHEMES, default="ibug68")
    add_head_model(parser)
    parser.add_argument("--shape-variance", type=float, default=0.99)
    parser.add_argument("--faces", type=int, default=256)
    parser.add_argument("--seed", type=seed, default=0)
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    if arguments.faces < 1:
        raise InputError(f"expected --faces of 1 or more; got {arguments.faces}")
    model = load_head_model(arguments.head_model).of(scheme_named(arguments.scheme), arguments.shape_variance)
    pixels = FACE / jnp.ptp(model.mean[:, :2], 0).max()
    model = model.scaled(pixels)
    rng = np.random.default_rng(arguments.seed)
    count = arguments.faces
    b = jnp.asarray(rng.normal(size=(count, len(model.deviations))) * np.asarray(model.deviations), jnp.float32)
    angles = np.radians(rng.uniform(-1, 1, (count, 3)) * list(MOST.values()))
    rotations = jax.vmap(rotation_matrix)(*jnp.asarray(angles, jnp.float32).T)
    heads = jax.vmap(model.reconstruct)(b)
    exact = jnp.einsum("nij,nlj->nli", rotations[:, :2], heads, precision="highest")
    solvers: dict[str, Callable[[jax.Array], Alignment]] = {
        "Figure 7, prior from the noise (default)": partial(align_head, model),
        "no prior": partial(align_head, model, noise=0.0),
        "default, then refined": lambda points: refine_head(model, points, align_head(model, points)),
    }
    rows = []
    for noise in NOISES:
        points = exact + noise * jnp.asarray(rng.normal(size=exact.shape), jnp.float32)
        for name, solver in solvers.items():
            solve = jax.jit(jax.vmap(solver))
            found: Alignment = solve(points)
            turned = np.einsum("nij,nkj->nik", found.camera.rotation, rotations)
            pose = np.degrees(Rotation.from_matrix(turned).magnitude())
            apart = np.linalg.norm(jax.vmap(model.reconstruct)(found.b) - heads, axis=(1, 2))
            shape = 100 * apart / np.linalg.norm(heads - heads.mean(1, keepdims=True), axis=(1, 2))
            rows.append(
                {
                    "noise px": noise,
                    "solver": name,
                    "pose median °": float(np.median(pose)),
                    "pose 95 % °": float(np.percentile(pose, 95)),
                    "shape median %": float(np.median(shape)),
                    "shape 95 % %": float(np.percentile(shape, 95)),
                    "rounds": float(np.median(found.rounds)),
                    "ms/face": 1000 * median_seconds(computed(solve, points), 1) / count,
                }
            )
    about = (
        f"{count} random heads of {arguments.head_model} ({arguments.scheme}, {len(model.deviations)} modes), "
        f"{', '.join(f'{angle} up to {most:g}°' for angle, most in MOST.items())}; faces of {FACE:g} px."
    )
    report.table(rows, COLUMNS, above=about)


if __name__ == "__main__":
    sys.exit(main())
