"""``jaxfit track``: faces through a video, from a file or a camera."""

import argparse
import csv
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path

import numpy as np

from jaxfit.cli.arguments import out_folder
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.detectors import DEFAULT_DETECTOR
from jaxfit.data.outputs import atomic_write
from jaxfit.data.overlays import draw_head, draw_landmarks, draw_name
from jaxfit.data.videos import Video, write_video
from jaxfit.evaluation.pose import ANGLES
from jaxfit.models.files import DEFAULT_MODEL, load
from jaxfit.models.model import Model
from jaxfit.smoothing import OneEuro
from jaxfit.tracking import TrackedFace, TrackedFrame, track


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "track",
        help="follow faces through a video",
        description="Follow faces through a video: landmarks, frame by frame, of people who keep their numbers. Writes "
        "faces.csv, a row a face a frame, and with --overlay the video with the faces drawn over it.",
    )
    command.add_argument(
        "video", metavar="VIDEO_OR_CAMERA", help="a video file, or the number of a camera (stop it with Ctrl-C)"
    )
    command.add_argument(
        "--model", default=DEFAULT_MODEL, help=f"a bundled model's name or a model file (default: {DEFAULT_MODEL})"
    )
    command.add_argument(
        "--detector",
        default=DEFAULT_DETECTOR,
        help=f"what finds new faces: haar, dlib, or yunet:FILE.onnx (default: {DEFAULT_DETECTOR})",
    )
    command.add_argument(
        "--redetect-every", type=int, default=10, metavar="N", help="look for new faces every N frames (default: 10)"
    )
    command.add_argument("--smooth", action="store_true", help="smooth the landmarks, less where the face moves")
    command.add_argument("--overlay", action="store_true", help="write overlay.mp4, which has no sound")
    command.add_argument("--out", required=True, metavar="DIR", help="where the results go")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Track and write; 1 if there was no face at all."""
    model = load(options.model)
    source = options.video
    camera = source.isdigit() and not Path(source).exists()
    problems: list[str] = []
    frames = faces = 0
    people: set[int] = set()
    with ExitStack() as stack:
        video = stack.enter_context(Video(int(source) if camera else source))
        tracked = track(
            model,
            video,
            detector=options.detector,
            redetect_every=options.redetect_every,
            smoothing=OneEuro() if options.smooth else None,
        )
        folder = out_folder(options.out)
        table = csv.writer(stack.enter_context(atomic_write(folder / "faces.csv", "w")), lineterminator="\n")
        table.writerow(_header(model))
        film = stack.enter_context(_film(folder if options.overlay else None, video.frame_rate))
        bars = stack.enter_context(Bars())
        begun = time.perf_counter()
        # A camera has no end but this.
        with suppress(KeyboardInterrupt) if video.live else nullcontext():
            for frame in tracked:
                bars("tracking faces", frame.number, video.count or frame.number)
                table.writerows(_row(frame, face) for face in frame.faces)
                if frame.problem:
                    problems.append(frame.problem)
                film(frame, model)
                frames += 1
                faces += len(frame.faces)
                people |= {face.id for face in frame.faces}
        taken = time.perf_counter() - begun
    if video.problem:
        problems.append(video.problem)
    report_problems(problems)
    print(
        f"frames: {frames}, people: {len(people)}, faces: {faces}, faces/s: {faces / taken:.1f}, model: {options.model}"
    )
    written = ["faces.csv", *(["overlay.mp4"] if options.overlay else [])]
    print(f"written: {', '.join(str(folder / name) for name in written)}")
    return 0 if faces else 1


@contextmanager
def _film(folder: Path | None, frame_rate: float) -> Iterator[Callable[[TrackedFrame, Model], None]]:
    """What draws frames with their faces into ``overlay.mp4``; without a folder nothing."""
    if folder is None:
        yield lambda frame, model: None
        return
    with write_video(folder / "overlay.mp4", frame_rate) as write:
        yield lambda frame, model: write(_drawn(frame, model))


def _drawn(frame: TrackedFrame, model: Model) -> np.ndarray:
    """A frame with its faces and their numbers drawn over it."""
    canvas = frame.picture
    for face in frame.faces:
        if face.landmarks_3d is None or face.pose is None:
            canvas = draw_landmarks(canvas, face.landmarks, model.scheme)
        else:
            solid = np.column_stack([face.landmarks, face.landmarks_3d[:, 2]])
            canvas = draw_head(canvas, solid, face.pose, model.scheme)
        canvas = draw_name(canvas, str(face.id), face.box)
    return canvas


def _header(model: Model) -> list[str]:
    points = [f"{axis}{i}" for i in range(1, model.scheme.count + 1) for axis in "xy"]
    pose = [*ANGLES, "scale"] if model.solid is not None else []
    return ["frame", "seconds", "id", "confidence", "x", "y", "width", "height", *points, *pose]


def _row(frame: TrackedFrame, face: TrackedFace) -> list[object]:
    confidence = "" if face.confidence is None else f"{face.confidence:.3f}"
    numbers = [*face.box, *face.landmarks.reshape(-1)]
    if face.pose is not None and face.scale is not None:
        numbers += [*face.pose, face.scale]
    return [frame.number, f"{frame.seconds:.3f}", face.id, confidence, *(f"{value:.3f}" for value in numbers)]
