"""Build a head model, the 3D shapes of faces, from ICT-FaceKit or from FaceWarehouse's own files (thesis 3.3).

As the thesis has 150 people and 20 expressions of each, so many are drawn from ICT-FaceKit.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from jaxfit.cli.arguments import seed
from jaxfit.cli.main import exit_code
from jaxfit.cli.progress import report_problems
from jaxfit.data.overlays import draw_landmarks
from jaxfit.data.pictures import write_image
from jaxfit.heads.facekit import FACEKIT_SOURCE, FaceKit, facekit_points, read_facekit, sample_heads
from jaxfit.heads.facewarehouse import read_facewarehouse
from jaxfit.heads.mesh_points import MeshPoints, read_mesh_points, union
from jaxfit.heads.model import HeadModel, learn_head_model, save_head_model
from jaxfit.models.files import check_target
from jaxfit.schemes.known import scheme_named

FACEWAREHOUSE_SOURCE = "FaceWarehouse (Cao et al. 2014), for research under its authors' agreement only"

PANEL, PIXELS = (340, 330), 15  # width and height of a drawn head, and pixels a centimetre
MIDDLE = np.array([0.0, -0.5, -4.0])
SIDE = 75.0  # degrees
# ICT-FaceKit's vertices from here on are lashes and films over the eyes, which hide them when drawn.
SOLID = 24591


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    heads = parser.add_mutually_exclusive_group(required=True)
    heads.add_argument("--facekit", metavar="FILE", help="ICT-FaceKit as one .npz file, see jaxfit.heads.facekit")
    heads.add_argument("--facewarehouse", metavar="DIR", help="the folder of Tester_1, Tester_2, …")
    parser.add_argument("--points", metavar="FILE", help="sets of landmarks on the mesh, see jaxfit.heads.mesh_points")
    parser.add_argument("--people", type=int, default=150, help="drawn from ICT-FaceKit; FaceWarehouse has its own")
    parser.add_argument("--expressions", type=int, default=20, help="of each, the neutral one included")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument(
        "--unit", type=float, default=10.0, help="centimetres in FaceWarehouse's unit, assumed to be the decimetre"
    )
    parser.add_argument(
        "--meshes", choices=("poses", "blendshapes"), default="poses", help="of FaceWarehouse: 20 or 47 of each person"
    )
    parser.add_argument("--variance", type=float, default=0.9995, help="share of the variance to keep")
    parser.add_argument("--out", metavar="FILE", required=True, help="the head model, ending in .safetensors")
    parser.add_argument("--render", metavar="FILE", help="draw the landmarks on ICT-FaceKit's mean head")
    arguments = parser.parse_args()
    if arguments.facewarehouse and (not arguments.points or arguments.render):
        parser.error("--facewarehouse needs --points, and draws no --render")
    return exit_code(run, arguments)


def run(arguments: argparse.Namespace) -> int:
    check_target(Path(arguments.out))
    sets = read_mesh_points(arguments.points) if arguments.points else facekit_points()
    points, indices = union(sets)
    if arguments.facekit:
        facekit = read_facekit(arguments.facekit)
        heads = sample_heads(facekit, points, arguments.people, arguments.expressions, arguments.seed)
        source, reference = FACEKIT_SOURCE, points.at(facekit.generic)
    else:
        heads, problems = read_facewarehouse(arguments.facewarehouse, points, arguments.meshes)
        report_problems(problems)
        heads *= arguments.unit
        source, reference = FACEWAREHOUSE_SOURCE, heads.mean(0)
    head = learn_head_model(heads, indices, arguments.variance, source)
    save_head_model(head, arguments.out)
    report(head, len(heads), reference)
    print(f"{arguments.out}: {Path(arguments.out).stat().st_size} bytes")
    if arguments.render:
        write_image(arguments.render, render(facekit, sets))
    return 0


def report(head: HeadModel, heads: int, reference: np.ndarray) -> None:
    """What was learned from so many heads, and how the mean is turned from ``reference`` (L, 3), a frontal head."""
    shape, mean = head.shape, np.asarray(head.shape.mean, np.float64)
    width, height, depth = np.ptp(mean, axis=0)
    print(f"{heads} heads, {len(mean)} points, {len(shape.deviations)} modes; {head.source}")
    print(
        f"mean: {width:.1f} × {height:.1f} × {depth:.1f} cm; total deviation {np.linalg.norm(shape.deviations):.2f} cm"
    )
    turn = Rotation.align_vectors(mean, reference - reference.mean(0))[0].as_rotvec(degrees=True)
    print(f"turned from the head it is compared with by {np.round(turn, 2)} degrees about x, y, z")
    for name in head.sets:
        scheme = scheme_named(name)
        whole, thesis = head.of(scheme, 1.0), head.of(scheme, 0.95)
        told = ""
        if scheme.mirror:
            face = np.asarray(whole.mean)
            lack = np.linalg.norm(face[list(scheme.mirror)] * [-1, 1, 1] - face, axis=1).max()
            told = f", mean symmetric within {10 * lack:.2f} mm"
        print(f"{name}: {len(whole.deviations)} modes, 95 % of the variance in {len(thesis.deviations)}{told}")


def render(facekit: FaceKit, sets: dict[str, MeshPoints]) -> np.ndarray:
    """The sets on the mean head, RGB: a column for each set, from the front above and from the side below."""
    rows = []
    for degrees in (0.0, SIDE):
        turn = Rotation.from_euler("y", degrees, degrees=True)
        picture = _shaded(facekit, turn)
        panels = []
        for name, points in sets.items():
            landmarks = points.at(facekit.generic)
            seen = _pixels(landmarks, turn)
            # From the side the head hides its other half.
            seen[landmarks[:, 0] * np.sign(degrees) < -0.1] = np.nan
            panels.append(draw_landmarks(picture, seen, scheme_named(name)))
        rows.append(np.hstack(panels))
    return np.vstack(rows)


def _shaded(facekit: FaceKit, turn: Rotation) -> np.ndarray:
    quads = facekit.quads[(facekit.quads < SOLID).all(1)]
    # A triangle's fourth corner is its third again.
    quads = np.where(quads < 0, quads[:, 2:3], quads)
    corners = turn.apply(facekit.generic)[quads]
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    # A fourth corner that repeats another leaves the diagonals' product as it is, or zero.
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    light = np.array([-0.3, -0.4, -0.85])
    shades = 60 + 12 * (15 * np.abs(normals @ light / np.linalg.norm(light))).astype(int)
    outlines = np.round(_pixels(facekit.generic, turn)[quads] * 16).astype(np.int32)
    picture = np.full((PANEL[1], PANEL[0], 3), 255, np.uint8)
    # The nearest last, over what lies behind.
    for index in np.argsort(-corners[:, :, 2].mean(1)):
        cv2.fillConvexPoly(picture, outlines[index], (int(shades[index]),) * 3, shift=4)
    return picture


def _pixels(points: np.ndarray, turn: Rotation) -> np.ndarray:
    """Where points (N, 3), turned, are seen (N, 2) by a parallel projection."""
    return turn.apply(points - MIDDLE)[:, :2] * PIXELS + np.array(PANEL) / 2


if __name__ == "__main__":
    sys.exit(main())
