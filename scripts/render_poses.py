"""Turn the heads of labelled pictures far to the side, up and down: training pictures of poses that few data sets have.

The face is aligned with the head model, the picture gets the head's depth, and is drawn as seen after a turn (the idea
of face profiling, as 300W-LP was made). Landmarks turn with the head, hidden ones too. A killed run goes on where it
was; another seed and another folder give other poses of the same faces.
"""

import argparse
import sys
import zlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import RBFInterpolator

from jaxfit.cli.arguments import add_datasets, add_head_model, out_folder, seed
from jaxfit.cli.main import exit_code
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.crops import cut_face, to_crop
from jaxfit.data.outputs import require_same_settings
from jaxfit.data.pictures import read_grey, write_image
from jaxfit.data.pts import write_pts
from jaxfit.errors import ImageError, InputError
from jaxfit.heads.facekit import FaceKit, facekit_points, read_facekit, sample_heads
from jaxfit.heads.mesh_points import MeshPoints
from jaxfit.heads.model import load_head_model
from jaxfit.image.frame import Frame
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import FaceRecord
from jaxfit.schemes.known import IBUG68
from jaxfit.shapes.alignment import Alignment, align_head
from jaxfit.shapes.asm import ActiveShapeModel
from jaxfit.shapes.camera import pose_degrees, pose_rotation, rotation_angles, show

FRAME = Frame(crop=288, face=120.0)
WORST = 0.04  # mean distance of labels and aligned head above which a face is left out, in sides of the face
VARIANCE = 0.99  # kept by the model of the landmarks

# ICT-FaceKit's vertices up to here are the skin of face, head and neck; then come the insides of mouth and eyes.
SKIN = 11248
NECK = 4.0  # centimetres below the chin that belong to the head; what lies deeper stays with the background
PEOPLE, EXPRESSIONS = 80, 5  # that the dense head is learned from

LEAST_YAW, MOST_YAW, LEAST_PITCH, MOST_PITCH = 30.0, 90.0, 15.0, 55.0  # degrees, of the rendered heads
FRONTAL = 10.0  # degrees of yaw, or pitch, below which a face may be turned to either side
NEAR = 8.0  # degrees, of the change of pitch, or yaw, where it shall stay
ROLL = 10.0  # degrees, of the change of roll

HAIR, STILL = 0.08, 0.45  # distances from the head up to which all turns with it and from which nothing moves, in faces
# Within the first distance from the line of the jaw, in faces, depths follow the labels, and skin gets its colour from
# as far inside as the second: where labels, head and picture do not meet exactly, the background would be smeared over
# the cheek.
RIM, INSIDE = 0.12, 0.05
MOST_GAP = 0.4  # of a label's depth to the head's in its pixel that is believed, in faces
SPACING = 1.5  # pixels between the points of the picture that are turned
BITS = 4  # OpenCV takes coordinates as integers; these are binary digits after the point


@dataclass(frozen=True)
class DenseHead:
    """The skin of a head as it goes with the coefficients of a model of its landmarks, in cm.

    Attributes:
        mean: (V, 3) with all coefficients 0.
        modes: (M, V, 3) how one unit of each coefficient moves the vertices.
        quads: (F, 4) vertices of each face of the mesh.
    """

    mean: np.ndarray
    modes: np.ndarray
    quads: np.ndarray


@dataclass(frozen=True)
class View:
    """A head as a crop shows it: x and y in pixels of the crop, z, away from the viewer, in the same unit.

    Attributes:
        vertices: (V, 3) of the dense head.
        landmarks: (L, 3) the labels, with the model's depths.
        rotation: (3, 3) from the head's axes to the picture's.
    """

    vertices: np.ndarray
    landmarks: np.ndarray
    rotation: np.ndarray

    @property
    def pose(self) -> np.ndarray:
        """(3,) roll, pitch and yaw in degrees."""
        return np.asarray(pose_degrees(*rotation_angles(jnp.asarray(self.rotation, jnp.float32))), np.float64)

    @property
    def centre(self) -> np.ndarray:
        """(3,) the middle of the head, which turns leave where it is."""
        return (self.vertices.min(0) + self.vertices.max(0)) / 2


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_datasets(parser)
    parser.add_argument(
        "--facekit", metavar="FILE", required=True, help="ICT-FaceKit as one .npz file, see jaxfit.heads.facekit"
    )
    add_head_model(parser)
    parser.add_argument("--most", type=int, metavar="N", help="faces of each dataset, spread evenly over it")
    parser.add_argument("--per-subject", type=int, metavar="N", help="faces of each subject, spread evenly")
    parser.add_argument(
        "--turn",
        choices=TARGETS,
        default="sideways",
        help="far to the side, half of them up or down as well; or tilt only",
    )
    parser.add_argument("--seed", type=seed, default=0, help="of the poses")
    parser.add_argument("--out", required=True, metavar="DIR", help="where pictures and .pts files go")
    arguments = parser.parse_args()
    return exit_code(run, arguments)


def run(arguments: argparse.Namespace) -> int:
    datasets = read_datasets(arguments.data, arguments.scheme)
    problems: list[str] = []
    faces: dict[str, FaceRecord] = {}
    for dataset in datasets:
        if dataset.scheme != IBUG68:
            raise InputError(f"{dataset.spec}: expected labels of scheme {IBUG68.name}, found {dataset.scheme.name}")
        problems += dataset.problems
        folder = Path(dataset.spec.partition(":")[2]).resolve().name
        for face in chosen(dataset.faces, arguments.per_subject, arguments.most):
            # The name of the source, not the pose: pictures of one subject must stay together.
            if faces.setdefault(f"{folder}_{face.face}", face) is not face:
                raise InputError(f"--data: two faces would be called {folder}_{face.face}; rename a folder")
    model = load_head_model(arguments.head_model).of(IBUG68, VARIANCE)
    dense = learn_dense_head(read_facekit(arguments.facekit), model)
    out = out_folder(arguments.out)
    require_same_settings(
        out / "settings.json", {"seed": arguments.seed, "head": arguments.head_model, "turn": arguments.turn}
    )
    with Bars() as bars:
        for done, (name, face) in enumerate(faces.items(), 1):
            if not (out / f"{name}.pts").exists():
                try:
                    picture, landmarks = render_face(
                        face, model, dense, TARGETS[arguments.turn], generator(arguments.seed, name)
                    )
                    write_image(out / f"{name}.jpg", picture)
                    # Last, so that labels always have their picture.
                    write_pts(out / f"{name}.pts", landmarks)
                except (ImageError, InputError) as error:
                    problems.append(f"{name}: {error}")
            bars("rendering", done, len(faces))
    report_problems(problems)
    print(f"{out}: {sum((out / f'{name}.pts').exists() for name in faces)} of {len(faces)} faces rendered")
    return 0


def generator(number: int, name: str) -> np.random.Generator:
    """Random numbers of one face's own, whatever other faces are rendered."""
    return np.random.default_rng([number, zlib.crc32(name.encode())])


def chosen(faces: Sequence[FaceRecord], per_subject: int | None, most: int | None) -> list[FaceRecord]:
    """At most so many of each subject, and of these at most so many in all, spread evenly; only with all landmarks."""
    subjects = defaultdict(list)
    for face in faces:
        if face.complete:
            subjects[face.subject].append(face)
    return _spread([face for group in subjects.values() for face in _spread(group, per_subject)], most)


def _spread(items: list[FaceRecord], most: int | None) -> list[FaceRecord]:
    count = len(items) if most is None else min(max(most, 0), len(items))
    return [items[(2 * number + 1) * len(items) // (2 * count)] for number in range(count)]


def learn_dense_head(facekit: FaceKit, model: ActiveShapeModel) -> DenseHead:
    """How all of the skin goes with a model of the 68 landmarks, by least squares over random heads.

    Raises:
        InputError: the mesh is not ICT-FaceKit's.
        DatasetError: the face kit lacks an expression.
    """
    every = MeshPoints(np.arange(SKIN)[:, None], np.ones((SKIN, 1)))
    landmarks = facekit_points()[IBUG68.name]
    heads = sample_heads(facekit, every, PEOPLE, EXPRESSIONS)
    target, modes = np.asarray(model.mean, np.float64), np.asarray(model.modes, np.float64)
    deviations = np.asarray(model.deviations, np.float64)
    coefficients = np.empty((len(heads), len(modes)))
    for head, row in zip(heads, coefficients, strict=True):
        head[:] = _moved_to(landmarks.at(head), target, head)
        row[:] = np.tensordot(modes, landmarks.at(head) - target, 2) / deviations
    known = np.column_stack([np.ones(len(heads)), coefficients])
    # What few heads say of the faintest modes is not worth much: a prior as strong as some heads.
    prior = np.diag([0.0] + [5.0] * len(modes))
    found = np.linalg.solve(known.T @ known + prior, known.T @ heads.reshape(len(heads), -1))
    found = found.reshape(-1, SKIN, 3)
    # A triangle's fourth corner is its third again.
    quads = np.where(facekit.quads < 0, facekit.quads[:, 2:3], facekit.quads)
    lowest = landmarks.at(facekit.generic)[8, 1] + NECK
    kept = (quads < SKIN).all(1) & (facekit.generic[quads][..., 1] < lowest).all(1)
    used, quads = np.unique(quads[kept], return_inverse=True)
    return DenseHead(found[0, used], found[1:, used] / deviations[:, None, None], quads.reshape(-1, 4))


def _moved_to(points: np.ndarray, target: np.ndarray, all_points: np.ndarray) -> np.ndarray:
    """``all_points`` (V, 3) moved, turned and scaled as brings ``points`` (L, 3) of them nearest to ``target``."""
    middle, goal = points.mean(0), target.mean(0)
    left, sizes, right = np.linalg.svd((points - middle).T @ (target - goal))
    signs = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    scale = (sizes * signs).sum() / ((points - middle) ** 2).sum()
    return scale * (all_points - middle) @ (left * signs) @ right + goal


def render_face(
    face: FaceRecord, model: ActiveShapeModel, dense: DenseHead, target: "Target", rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A picture, uint8 (H, W), of a face turned to a random pose, drawn by ``target``, and its landmarks (L, 2).

    Raises:
        ImageError: the picture cannot be read.
        InputError: the head model does not fit the labels, or the face looks to the side or away already.
    """
    grey = read_grey(face.image)
    square = bounding_square(face.landmarks)
    crop = cut_face(grey, box_centre(square), square[2], FRAME)
    view = seen(model, dense, to_crop(face.landmarks, crop.scale, crop.offset))
    rotation = np.asarray(pose_rotation(jnp.asarray(target(view.pose, rng), jnp.float32)), np.float64)
    turn = rotation @ view.rotation.T
    landmarks = (view.landmarks - view.centre) @ turn.T + view.centre
    return render(crop.pixels, view, dense.quads, turn), landmarks[:, :2]


def seen(model: ActiveShapeModel, dense: DenseHead, points: np.ndarray) -> View:
    """The head that goes with landmarks (L, 2) of a crop.

    Raises:
        InputError: the head model does not fit the landmarks.
    """
    aligned: Alignment = _align(model, jnp.asarray(points, jnp.float32))
    error = float(aligned.error) / len(points) / FRAME.face
    if not aligned.camera.ok or error > WORST:
        raise InputError(f"left out: the head model lies {100 * error:.1f} % of the face beside the labels")
    b = np.asarray(aligned.b, np.float64)
    place, scale = np.append(aligned.camera.place, 0), float(aligned.camera.scale)
    rotation = np.asarray(aligned.camera.rotation, np.float64)
    vertices = scale * (dense.mean + np.tensordot(b, dense.modes, 1)) @ rotation.T + place
    landmarks = np.asarray(show(model.reconstruct(aligned.b), aligned.camera), np.float64)
    # Where labels and model differ the picture is right, or its features would not lie at their depths.
    apart = RBFInterpolator(landmarks, points - landmarks[:, :2], kernel="linear", degree=0, smoothing=20.0)
    vertices[:, :2] += apart(vertices)
    return View(vertices, np.column_stack([points, landmarks[:, 2]]), rotation)


_align = jax.jit(align_head)


def sideways(own: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Roll, pitch and yaw (3,) to turn a head to, in degrees: further to the side that it looks to.

    To the other side there is nothing in the picture of what would be seen. Half of the heads look up or down, too.

    Raises:
        InputError: the head looks to the side or away already.
    """
    roll, pitch, yaw = own
    if abs(yaw) > MOST_YAW - NEAR or abs(pitch) > MOST_PITCH:
        raise InputError(f"left out: its pitch and yaw are {pitch:.0f} and {yaw:.0f} degrees already")
    side = np.sign(yaw) if abs(yaw) > FRONTAL else rng.choice([-1.0, 1.0])
    new_yaw = side * rng.uniform(max(LEAST_YAW, abs(yaw)), MOST_YAW)
    new_pitch = np.clip(pitch + rng.uniform(-NEAR, NEAR), -MOST_PITCH, MOST_PITCH)
    if rng.uniform() < 0.5:
        new_pitch = rng.uniform(-MOST_PITCH, MOST_PITCH)
        if np.hypot(new_yaw / MOST_YAW, new_pitch / MOST_PITCH) > 1:
            new_pitch = rng.uniform(-MOST_PITCH, MOST_PITCH)  # both at once are rare
    return np.array([roll + rng.uniform(-ROLL, ROLL), new_pitch, new_yaw])


def tilted(own: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Roll, pitch and yaw (3,) to turn a head to, in degrees: up or down, further if it looks there already.

    Raises:
        InputError: the head looks far up, down or to the side already.
    """
    roll, pitch, yaw = own
    if abs(yaw) > MOST_PITCH or abs(pitch) > MOST_PITCH - NEAR:
        raise InputError(f"left out: its pitch and yaw are {pitch:.0f} and {yaw:.0f} degrees already")
    way = np.sign(pitch) if abs(pitch) > FRONTAL else rng.choice([-1.0, 1.0])
    new_pitch = way * rng.uniform(max(LEAST_PITCH, abs(pitch)), MOST_PITCH)
    return np.array([roll + rng.uniform(-ROLL, ROLL), new_pitch, yaw + rng.uniform(-NEAR, NEAR)])


Target = Callable[[np.ndarray, np.random.Generator], np.ndarray]
TARGETS: dict[str, Target] = {"sideways": sideways, "tilt": tilted}


def render(pixels: np.ndarray, view: View, quads: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """A crop, uint8 (crop, crop), as it is seen after the rotation ``turn`` (3, 3) of the head about its centre.

    What lies around the head stays where it is, and is stretched between there and the head.
    """
    side = len(pixels)
    depth, distance = depth_map(view, quads, side)
    # Yaw > 0 shows the side at the picture's right; what happens to the other is not seen.
    jaw = np.arange(8, 17) if (turn @ view.rotation)[0, 2] > 0 else np.arange(9)
    depth += jaw_correction(depth, view.landmarks[jaw])
    ticks = np.linspace(0, side - 1, round(side / SPACING) + 1, dtype=np.float32)
    x, y = np.meshgrid(ticks, ticks)
    there = np.stack([x, y, _sampled(depth, x, y)], 2).astype(np.float64)
    turned = (there - view.centre) @ turn.T + view.centre
    share = np.clip((_sampled(distance, x, y) / FRAME.face - HAIR) / (STILL - HAIR), 0, 1)[..., None]
    # The background is behind everything.
    there[..., 2] = view.centre[2] + FRAME.face
    points = turned + share**2 * (3 - 2 * share) * (there - turned)
    corners = np.stack([points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], 2).reshape(-1, 4, 3)
    # Where nothing moves the crop itself shows.
    moves = (share[:-1, :-1] < 1).ravel()
    canvas = cv2.resize(pixels, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    colours = skin_colours(pixels, view.landmarks[:, :2], jaw, ticks)
    _draw(canvas, (2 * corners + [0.5, 0.5, 0.0])[moves], colours[moves])
    return cv2.resize(canvas, (side, side), interpolation=cv2.INTER_AREA)


def skin_colours(pixels: np.ndarray, landmarks: np.ndarray, jaw: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Colours (K,) of the quads between ``ticks``; close to the half ``jaw`` of its line, of skin further inside."""
    up = landmarks[27] - landmarks[8]
    face = np.round(np.vstack([landmarks[:17], landmarks[[16, 0]] + up]) * 2**BITS).astype(np.int32)
    line = cv2.polylines(np.ones_like(pixels), [face[jaw]], False, 0, shift=BITS)
    inside = cv2.fillPoly(np.zeros(pixels.shape, np.float32), [face], 1.0, shift=BITS)
    distance = (2 * inside - 1) * cv2.distanceTransform(line, cv2.DIST_L2, 5)
    down, across = np.gradient(cv2.GaussianBlur(distance, (0, 0), 2))
    shift = inside * INSIDE * FRAME.face * np.clip(1 - distance / (RIM * FRAME.face), 0, 1)
    x, y = np.meshgrid(*2 * [(ticks[1:] + ticks[:-1]) / 2])
    return _sampled(pixels, x + _sampled(shift * across, x, y), y + _sampled(shift * down, x, y)).ravel()


def jaw_correction(depth: np.ndarray, jaw: np.ndarray) -> np.ndarray:
    """What to add to a map of depths (side, side) for it to have those of landmarks of the jaw (K, 3) near them.

    Seen from the front the side of a cheek is a few pixels wide but deep, so that small errors matter.
    """
    steps = np.linspace(0, len(jaw) - 1, 20 * (len(jaw) - 1) + 1)
    x, y, z = (np.interp(steps, range(len(jaw)), axis).astype(np.float32) for axis in jaw.T)
    gaps = np.clip(z - _sampled(depth, x, y).ravel(), 0, MOST_GAP * FRAME.face)
    columns, rows = (np.clip(np.round(axis), 0, len(depth) - 1).astype(int) for axis in (x, y))
    off_line = np.ones(depth.shape, np.uint8)
    off_line[rows, columns] = 0
    distance, nearest = cv2.distanceTransformWithLabels(off_line, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    gap_of = np.zeros(nearest.max() + 1, np.float32)
    gap_of[nearest[rows, columns]] = gaps
    near = np.clip(1 - distance / (RIM * FRAME.face), 0, 1)
    return cv2.GaussianBlur(gap_of[nearest], (0, 0), 2) * near**2 * (3 - 2 * near)


def depth_map(view: View, quads: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """The head's depth (side, side) in each pixel, beside it that of its nearest pixel; and the distance from it.

    Distances are in pixels, and negative inside the head.
    """
    corners = view.vertices[quads]
    # Through the openings of eyes and mouth the inside of the back would be seen.
    corners = corners[_faces_viewer(corners)]
    canvas = np.full((side, side), np.nan, np.float32)
    _draw(canvas, corners, corners[..., 2].mean(1))
    head = np.isfinite(canvas)
    if not head.any():
        raise InputError("left out: the head lies outside the picture")
    _, nearest = cv2.distanceTransformWithLabels(
        (~head).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    depth_of = np.zeros(nearest.max() + 1, np.float32)
    depth_of[nearest[head]] = canvas[head]
    # Spots far behind their surroundings are folds seen through an opening.
    continued = cv2.morphologyEx(depth_of[nearest], cv2.MORPH_OPEN, np.ones((7, 7), np.uint8))
    depth = np.where(head, continued, cv2.GaussianBlur(continued, (0, 0), 5))
    outlines, _ = cv2.findContours(head.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    solid = cv2.drawContours(np.zeros((side, side), np.uint8), outlines, -1, 1, cv2.FILLED)
    distance = cv2.distanceTransform(1 - solid, cv2.DIST_L2, 5) - cv2.distanceTransform(solid, cv2.DIST_L2, 5)
    return cv2.GaussianBlur(depth, (0, 0), 1.2), distance


def _draw(canvas: np.ndarray, corners: np.ndarray, colours: np.ndarray) -> None:
    """Fill quads (K, 4, 3) with colours (K,), the nearest last, over what lies behind."""
    order = np.argsort(-corners[..., 2].mean(1))
    outlines = np.round(np.clip(corners[order, :, :2], -1e4, 1e4) * 2**BITS).astype(np.int32)
    for outline, colour in zip(outlines, colours[order].tolist(), strict=True):
        cv2.fillConvexPoly(canvas, outline, colour, shift=BITS)


def _faces_viewer(corners: np.ndarray) -> np.ndarray:
    """Which of the head's quads (K, 4, 3) show their outer side."""
    across, down = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    return across[:, 0] * down[:, 1] < across[:, 1] * down[:, 0]


def _sampled(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


if __name__ == "__main__":
    sys.exit(main())
