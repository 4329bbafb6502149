"""By how many pixels labels lie right of what they mark: where faces are symmetric, and where their labels are.

Labels may count a picture's pixels from 0, from 1, or from their corners, and copies of a dataset may have been cut
differently from their labels. Mirrored pictures show it: what lies a pixel too far right in one lies as far to the left
in the other. For faces that look at the camera, the gradients of the picture are compared with those of its mirror
image about the labels' axis, moved by so many pixels; the axis about which most of them agree is the picture's.

Labels are read as `jaxfit train` reads them. What this finds is for its `--shift`, which assumes the same downwards.
"""

import argparse
import sys

import cv2
import numpy as np
from report import Report, dataset_names, measure, script_parser

from jaxfit.cli.arguments import add_datasets, seed
from jaxfit.data.pictures import read_grey
from jaxfit.errors import ImageError, InputError
from jaxfit.labels.datasets import read_datasets
from jaxfit.labels.records import Dataset

SHIFTS = np.arange(-4.0, 4.01, 0.5)  # of the axis, in pixels
STEEPEST = 15.0  # rotation in the picture, in degrees
ASYMMETRY = 0.08  # of labels about their axis, in sides of the face, that a face has at most that looks at the camera
SAMPLES = 200  # of the bootstrap


def main() -> int:
    parser = script_parser(__doc__)
    add_datasets(parser)
    parser.add_argument("--faces", type=int, default=900, help="that are looked at, of each dataset")
    parser.add_argument("--seed", type=seed, default=0, help="of the bootstrap")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    datasets, rows = read_datasets(arguments.data, arguments.scheme), []
    for name, dataset in zip(dataset_names(datasets), datasets, strict=True):
        if dataset.scheme.mirror is None:
            raise InputError(f"{dataset.spec}: landmarks that are not known to be symmetric")
        likeness, sides = likenesses(dataset, arguments.faces)
        if len(likeness) < 2:
            raise InputError(f"{dataset.spec}: expected two faces or more that look at the camera")
        rng = np.random.default_rng(arguments.seed)
        drawn = [peak(likeness[rng.integers(0, len(likeness), len(likeness))].mean(0)) for _ in range(SAMPLES)]
        rows.append(
            {
                "dataset": name,
                "faces": len(likeness),
                "face, pixels": np.median(sides),
                "labels lie to the right by, pixels": -peak(likeness.mean(0)),
                "±": np.std(drawn),
            }
        )
    columns = {
        "dataset": "",
        "faces": "d",
        "face, pixels": ".0f",
        "labels lie to the right by, pixels": ".2f",
        "±": ".2f",
    }
    report.table(rows, columns)


def likenesses(dataset: Dataset, most: int) -> tuple[np.ndarray, np.ndarray]:
    """How alike pictures of some faces and their mirror images are, (faces, SHIFTS), one a place of the axis; and the
    faces' sides in pixels."""
    mirror = np.asarray(dataset.scheme.mirror)
    found, sides = [], []
    for face in dataset.faces[:: max(1, len(dataset.faces) // most)]:
        if not face.complete or (placed := axis(face.landmarks, mirror)) is None:
            continue
        try:
            grey = read_grey(face.image).astype(np.float32)
        except ImageError:
            continue
        middle, degrees, side = placed
        found.append([symmetry(grey, middle + [shift, 0.0], degrees, side) for shift in SHIFTS])
        sides.append(side)
    return np.array(found), np.array(sides)


def axis(landmarks: np.ndarray, mirror: np.ndarray) -> tuple[np.ndarray, float, float] | None:
    """A point of the labels' axis of symmetry, the face's rotation in degrees and its side; None unless it looks at the
    camera and stands upright."""
    numbers = np.arange(len(landmarks))
    across = (landmarks[mirror] - landmarks)[numbers < mirror].sum(0)
    across *= np.sign(across[0]) or 1.0  # from left to right, whichever comes first
    degrees = float(np.degrees(np.arctan2(across[1], across[0])))
    side = float(np.ptp(landmarks, 0).max())
    middle = landmarks.mean(0)
    along = (landmarks - middle) @ across / np.linalg.norm(across)
    turned = np.abs(along + along[mirror]).mean() > ASYMMETRY * side
    return None if turned or abs(degrees) > STEEPEST else (middle, degrees, side)


def symmetry(grey: np.ndarray, middle: np.ndarray, degrees: float, side: float) -> float:
    """How alike a picture and its mirror image are around a point, from -1 to 1."""
    width = int(side * 1.1) // 2 * 2 + 1
    turn: np.ndarray = cv2.getRotationMatrix2D((float(middle[0]), float(middle[1])), degrees, 1.0)
    turn[:, 2] += (width - 1) / 2 - middle
    part = cv2.warpAffine(grey, turn, (width, width), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    part = cv2.GaussianBlur(part, (0, 0), 1.0)
    window = cv2.createHanningWindow((width, width), cv2.CV_32F)
    dx, dy = (cv2.Sobel(part, cv2.CV_32F, *order) * window for order in ((1, 0), (0, 1)))
    return float((np.sum(dy * dy[:, ::-1]) - np.sum(dx * dx[:, ::-1])) / max(np.sum(dx**2 + dy**2), 1e-6))


def peak(curve: np.ndarray) -> float:
    """Where a curve over SHIFTS is highest, by the parabola through the three highest points."""
    at = int(np.clip(curve.argmax(), 1, len(SHIFTS) - 2))
    before, top, after = curve[at - 1 : at + 2]
    bend = before - 2 * top + after
    return (
        float(SHIFTS[at] + (SHIFTS[1] - SHIFTS[0]) * (before - after) / (2 * bend) * (bend < 0)) if bend else SHIFTS[at]
    )


if __name__ == "__main__":
    sys.exit(main())
