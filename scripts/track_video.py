"""How well faces are tracked through videos, beside detecting and fitting each frame by itself.

The videos are made from labelled pictures that move, so that where the landmarks are is known in every frame. A killed
run goes on where it was: results of each video are kept in ``--out``.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from report import Report, dataset_names, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets, out_folder
from jaxfit.cli.progress import Bars
from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.outputs import atomic_write, require_same_settings, write_csv
from jaxfit.data.pictures import read_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.errors import nmed
from jaxfit.fitting import OneEuro, Tracker
from jaxfit.labels.datasets import read_datasets, shared_scheme
from jaxfit.labels.records import FaceRecord
from jaxfit.schemes.normalisers import normaliser_length
from jaxfit.schemes.scheme import Scheme

WIDTH, HEIGHT, FRAMES, RATE = 640, 480, 60, 30.0
FACE = 150.0  # side of a face's square, in pixels
NOISE = 3.0  # grey levels
GOOD, FAIR, NOBODY = 0.08, 0.15, 0.3  # NMED of good and fair fits, and from which a fit is none of the face


@dataclass(frozen=True)
class Place:
    """Where a face is in a frame: its square's centre and side in pixels, its rotation in degrees."""

    x: float = WIDTH / 2
    y: float = HEIGHT / 2
    side: float = FACE
    degrees: float = 0.0


# Where the face is when the share t of the video has passed.
MOTIONS: dict[str, Callable[[float], Place]] = {
    "still": lambda t: Place(),
    "pan": lambda t: Place(x=WIDTH / 2 + 120 * np.sin(2 * np.pi * t)),
    "zoom": lambda t: Place(side=FACE * np.exp(0.45 * np.sin(2 * np.pi * t))),
    "rotation": lambda t: Place(degrees=20 * np.sin(2 * np.pi * t)),
    "leaving": lambda t: Place(x=WIDTH / 2 - 420 * (1 - np.cos(2 * np.pi * t)) / 2),
}


@dataclass(frozen=True)
class Clip:
    """A video: frames (H, W) uint8, and the landmarks (frames, people, L, 2) of all who are ever in it, else NaN."""

    motion: str
    frames: list[np.ndarray]
    truth: np.ndarray

    @property
    def in_view(self) -> np.ndarray:
        """(frames, people) bool: who is wholly in the picture."""
        height, width = self.frames[0].shape
        return np.all((self.truth >= 0) & (self.truth < [width, height]), axis=(2, 3))


class Reported(NamedTuple):
    """The faces that a method reports in a frame: whose they are (n,), and their landmarks (n, L, 2)."""

    ids: np.ndarray
    landmarks: np.ndarray


Frames = Sequence[np.ndarray]
Method = Callable[[Frames], list[Reported]]


def main() -> int:
    parser = script_parser(__doc__, out="results")
    add_datasets(parser)
    parser.add_argument("--model", default="fast68")
    parser.add_argument("--detector", default="haar")
    parser.add_argument("--redetect-every", type=int, default=10, metavar="N")
    parser.add_argument("--videos", type=int, default=10, help="of each motion")
    parser.add_argument("--seed", type=int, default=0)
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    datasets = read_datasets(arguments.data, arguments.scheme)
    scheme = shared_scheme(datasets)
    model = jaxfit.load(arguments.model)
    if model.scheme != scheme:
        raise InputError(f"expected labels like the model's, {model.scheme.name}; got {scheme.name}: see --scheme")
    folder = out_folder(arguments.out)
    settings = {key: value for key, value in sorted(vars(arguments).items()) if key not in ("data", "out")}
    settings["datasets"] = dataset_names(datasets)
    require_same_settings(folder / "settings.json", settings)
    rng = np.random.default_rng(arguments.seed)
    faces = [face for dataset in datasets for face in dataset.faces if face.complete]
    chosen = [faces[number] for number in rng.permutation(len(faces))[: 2 * arguments.videos]]
    pairs = list(zip(chosen[::2], chosen[1::2], strict=True))
    methods: dict[str, Method] = {
        "tracked": partial(tracked, model, arguments, None),
        "tracked, smoothed": partial(tracked, model, arguments, OneEuro()),
        "each frame by itself": partial(detected, model, arguments.detector),
    }
    kinds = [*MOTIONS, "cut", "pair"]
    rows = []
    with Bars() as bars:
        for number, pair in enumerate(pairs):
            for step, motion in enumerate(kinds):
                bars("tracking", number * len(kinds) + step, len(pairs) * len(kinds))
                path = folder / f"{number:03}-{motion}.json"
                if not path.exists():
                    clip = make(motion, pair, np.random.default_rng([arguments.seed, number, step]))
                    for method in methods.values():
                        method(clip.frames[:1])  # compiles
                    measured = [
                        {"method": name, **measured_on(clip, method, scheme)} for name, method in methods.items()
                    ]
                    with atomic_write(path, "w") as file:
                        json.dump(measured, file)
                rows += [{"motion": motion, **row} for row in json.loads(path.read_text(encoding="utf-8"))]
    by_method = [{"method": name, **summary([r for r in rows if r["method"] == name])} for name in methods]
    by_motion = [
        {
            "motion": motion,
            **{name: shares([r for r in rows if (r["method"], r["motion"]) == (name, motion)]) for name in methods},
        }
        for motion in kinds
    ]
    write_csv(folder / "videos.csv", list(rows[0]), [list(row.values()) for row in rows])
    about = (
        f"{len(pairs)} videos of each of {len(kinds)} motions, {FRAMES} frames of {WIDTH} x {HEIGHT} pixels at "
        f"{RATE:.0f} a second, faces of {FACE:.0f} pixels from {' and '.join(settings['datasets'])}, "
        f"{arguments.model}, {arguments.detector}."
    )
    formats = {"method": "", "good": ".1%", "fair": ".1%", "switches": "d", "again": "", "false": ".1f"}
    formats |= {"jitter": ".4f", "lag": ".0f", "moving NMED": ".4f", "frames/s": ".0f"}
    report.title = "Faces tracked through videos"
    report.table(by_method, formats, above=about)
    report.table(by_motion, {"motion": "", **dict.fromkeys(methods, "")})


def make(motion: str, pair: tuple[FaceRecord, FaceRecord], rng: np.random.Generator) -> Clip:
    """A video of one person, of two after a cut, or of two side by side."""
    times = np.arange(FRAMES) / FRAMES
    if motion == "cut":
        halves = [moving(face, MOTIONS["pan"], times[: FRAMES // 2], WIDTH) for face in pair]
        frames = [frame for pictures, _ in halves for frame in pictures]
        truth = np.full((FRAMES, 2, *halves[0][1].shape[1:]), np.nan)
        truth[: FRAMES // 2, 0], truth[FRAMES // 2 :, 1] = halves[0][1], halves[1][1]
    elif motion == "pair":
        middle = WIDTH / 2
        ways = [
            lambda t: Place(x=middle / 2 + 40 * np.sin(2 * np.pi * t)),
            lambda t: Place(x=middle / 2, degrees=20 * t),
        ]
        sides = [moving(face, way, times, WIDTH // 2) for face, way in zip(pair, ways, strict=True)]
        frames = [np.hstack(both) for both in zip(*(pictures for pictures, _ in sides), strict=True)]
        truth = np.stack([points + [side * middle, 0] for side, (_, points) in enumerate(sides)], 1)
    else:
        frames, points = moving(pair[0], MOTIONS[motion], times, WIDTH)
        truth = points[:, None]
    noisy = [np.clip(frame + rng.normal(0, NOISE, frame.shape), 0, 255).astype(np.uint8) for frame in frames]
    return Clip(motion, noisy, truth)


def moving(
    face: FaceRecord, way: Callable[[float], Place], times: np.ndarray, width: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """A face's picture at each time, (HEIGHT, width), and the landmarks there, (times, L, 2)."""
    grey = read_grey(face.image)
    square = bounding_square(face.landmarks)
    # Shrunk well first: warping a large picture would leave out pixels.
    shrink = min(1.0, 1.6 * FACE / square[2])
    grey = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    landmarks = (face.landmarks + 0.5) * shrink - 0.5
    square = bounding_square(landmarks)
    frames, truth = [], []
    for t in times:
        place = way(float(t))
        cos, sin = np.cos(np.radians(place.degrees)), np.sin(np.radians(place.degrees))
        turned = place.side / square[2] * np.array([[cos, -sin], [sin, cos]])
        offset = np.array([place.x, place.y]) - turned @ box_centre(square)
        frames.append(cv2.warpAffine(grey, np.c_[turned, offset], (width, HEIGHT), borderMode=cv2.BORDER_REPLICATE))
        truth.append(landmarks @ turned.T + offset)
    return frames, np.array(truth)


def tracked(
    model: jaxfit.Model, arguments: argparse.Namespace, smoothing: OneEuro | None, frames: Frames
) -> list[Reported]:
    tracker = Tracker(model, arguments.detector, redetect_every=arguments.redetect_every, smoothing=smoothing)
    found = [tracker.update(frame, number / RATE) for number, frame in enumerate(frames)]
    return [Reported(frame.ids, frame.faces.landmarks) for frame in found]


def detected(model: jaxfit.Model, detector: str, frames: Frames) -> list[Reported]:
    found = []
    for frame in frames:
        faces = jaxfit.detect_faces(frame, detector)
        fits = jaxfit.fit(model, [frame] * len(faces), [face.box for face in faces], kind=[face.kind for face in faces])
        landmarks = fits.landmarks[fits.fitted]
        found.append(Reported(np.zeros(len(landmarks), int), landmarks))
    return found


def measured_on(clip: Clip, method: Method, scheme: Scheme) -> dict[str, object]:
    """What a method finds in a video, in numbers that can be added up."""
    begun = time.perf_counter()
    reported = method(clip.frames)
    taken = time.perf_counter() - begun
    people, in_view = clip.truth.shape[1], clip.in_view
    errors = np.full(in_view.shape, np.inf)
    offsets = np.full(clip.truth.shape, np.nan)
    ids = np.zeros(in_view.shape, int)
    false = 0
    for k, faces in enumerate(reported):
        nearest = np.full(len(faces.ids), np.inf)
        for person in range(people):
            truth = clip.truth[k, person]
            if np.isnan(truth).any() or not len(faces.ids):
                continue
            of_faces = nmed(faces.landmarks, np.repeat(truth[None], len(faces.ids), 0), scheme)
            best = int(of_faces.argmin())
            nearest = np.minimum(nearest, of_faces)
            if of_faces[best] < FAIR:
                errors[k, person], ids[k, person] = of_faces[best], faces.ids[best]
                offsets[k, person] = faces.landmarks[best] - truth
        false += int((nearest > NOBODY).sum())
    velocities = np.gradient(np.nan_to_num(clip.truth), axis=0)
    eyes = np.stack([normaliser_length(np.nan_to_num(clip.truth[:, p]), scheme, "outer") for p in range(people)], 1)
    fair = (errors < FAIR) & in_view
    steady = fair[2:] & fair[1:-1] & fair[:-2]
    shaken = (offsets[2:] - 2 * offsets[1:-1] + offsets[:-2])[steady] / eyes[1:-1][steady][:, None, None]
    moving = fair & (clip.motion == "pan")  # where the lag is measured: all points move alike
    jumps, again = 0, None
    for person in range(people):
        known = ids[fair[:, person], person]
        jumps += int((np.diff(known) != 0).sum()) if clip.motion != "leaving" else 0
        if clip.motion == "leaving":
            half = FRAMES // 2
            first, second = ids[:half][fair[:half, person], person], ids[half:][fair[half:, person], person]
            if len(first):
                again = bool(len(second) and second[-1] == first[-1])
    return {
        "frames": len(reported),
        "seconds": taken,
        "in view": int(in_view.sum()),
        "good": int((errors[in_view] < GOOD).sum()),
        "fair": int(fair.sum()),
        "switches": jumps,
        "again": again,
        "false": false,
        "shaken": float((shaken**2).sum()),
        "shakes": int(steady.sum()) * scheme.count,
        "behind": float(-(offsets[moving] * velocities[moving]).sum()),
        "moved": float((velocities[moving] ** 2).sum()),
        "moving error": float(errors[moving].sum()),
        "moving": int(moving.sum()),
    }


def summary(rows: list[dict]) -> dict[str, object]:
    """A row of the table: shares of the faces in view, ids, false faces per 1000 frames, jitter, lag in ms."""
    total = {key: sum(row[key] for row in rows) for key in rows[0] if key not in ("method", "motion", "again")}
    back = [row["again"] for row in rows if row["again"] is not None]
    return {
        "good": total["good"] / total["in view"],
        "fair": total["fair"] / total["in view"],
        "switches": total["switches"],
        "again": f"{sum(back)} of {len(back)}",
        "false": 1000 * total["false"] / total["frames"],
        "jitter": float(np.sqrt(total["shaken"] / total["shakes"])),
        "lag": 1000 / RATE * total["behind"] / total["moved"],
        "moving NMED": total["moving error"] / total["moving"],
        "frames/s": total["frames"] / total["seconds"],
    }


def shares(rows: list[dict]) -> str:
    """Shares of the faces in view that are good, and fair."""
    in_view = sum(row["in view"] for row in rows)
    return " / ".join(f"{sum(row[key] for row in rows) / in_view:.1%}" for key in ("good", "fair"))


if __name__ == "__main__":
    sys.exit(main())
