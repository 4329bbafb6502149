"""``jaxfit track``: faces through a video, from a file or a camera."""

import argparse
import csv
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np

import jaxfit
from jaxfit.cli.arguments import (
    add_camera,
    add_detector,
    add_heads,
    add_unshift,
    given_placing,
    given_search,
    given_unshift,
)
from jaxfit.cli.progress import Bars, report_problems, say, warn
from jaxfit.data.inputs import require_no_inputs
from jaxfit.data.locks import held
from jaxfit.data.outputs import MANIFEST, atomic_write, replace_results, require_own_folder
from jaxfit.data.overlays import draw_name, draw_row
from jaxfit.data.rows import HEAD, PLACE, landmark_columns, table_text
from jaxfit.data.videos import Video, write_video
from jaxfit.fitting.one_euro import OneEuro
from jaxfit.fitting.pipeline import Fitting, usual_detector
from jaxfit.fitting.track import TrackedFrame, track
from jaxfit.heads.with_heads import ensure_heads
from jaxfit.models.files import DEFAULT_MODEL, load
from jaxfit.models.model import Model
from jaxfit.runs.run_folder import file_digests, run_files
from jaxfit.shapes.camera import ANGLES

_COMMAND, _TABLE, _OVERLAY = "jaxfit track", "faces.csv", "overlay.webm"


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "track",
        help="follow faces through a video",
        description="Follow faces through a video: landmarks in each frame, and a number for each person. "
        "Writes faces.csv, with a row for each face in each frame, and with --overlay the video "
        "with the faces drawn in.",
    )
    command.add_argument(
        "video", metavar="VIDEO_OR_CAMERA", help="a video file, or the number of a camera (stop it with Ctrl-C)"
    )
    command.add_argument(
        "--model", default=DEFAULT_MODEL, help=f"a bundled model's name or a model file (default: {DEFAULT_MODEL})"
    )
    add_detector(command, "finds new faces; yunet unless given, or whole for models that only know whole pictures")
    command.add_argument(
        "--redetect-every", type=int, default=10, metavar="N", help="look for new faces every N frames (default: 10)"
    )
    command.add_argument("--smooth", action="store_true", help="smooth the landmarks, less where the face moves fast")
    add_unshift(command)
    add_heads(command)
    add_camera(command)
    command.add_argument("--overlay", action="store_true", help=f"write {_OVERLAY}, which has no sound")
    command.add_argument("--out", required=True, metavar="DIR", help="where the results go")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Track and write; 1 if there was no face at all."""
    placing = given_placing(options)
    model = load(options.model)
    warn(given_unshift(options, model.cascade.frame))
    model = model.unshifted() if options.unshift else model
    model = ensure_heads(model) if options.heads or placing is not None else model
    source = options.video
    camera = source.isdigit() and not Path(source).exists()
    with Video(int(source) if camera else source) as video:
        tracked = track(
            model,
            video,
            detector=options.detector or usual_detector(model),
            search=given_search(options),
            redetect_every=options.redetect_every,
            smoothing=OneEuro() if options.smooth else None,
            placing=placing,
        )
        require_own_folder(options.out, _COMMAND)
        with held(options.out, _COMMAND):
            return _write(options, model, video, tracked)


def _write(options: argparse.Namespace, model: Model, video: Video, tracked: Iterator[TrackedFrame]) -> int:
    """Track, and write what was found, and the problems; 1 if there was no face at all."""
    folder, written = Path(options.out), [_TABLE, *([_OVERLAY] if options.overlay else [])]
    require_no_inputs([folder / name for name in (*written, MANIFEST)], [options.video, options.model])
    problems: list[str] = []
    frames = faces = 0
    people: set[int] = set()
    with ExitStack() as stack:
        table = csv.writer(stack.enter_context(atomic_write(folder / _TABLE, "w")), lineterminator="\n")
        columns = _columns(model, placed=given_placing(options) is not None)
        table.writerow(["frame", "seconds", "id", *(name.removeprefix(HEAD) for name in columns)])
        film = stack.enter_context(_film(folder if options.overlay else None, video.frame_rate))
        bars = stack.enter_context(Bars())
        begun = time.perf_counter()
        # A camera has no end but this.
        with suppress(KeyboardInterrupt) if video.live else nullcontext():
            for frame in tracked:
                bars("tracking faces", frame.number, max(video.count, frame.number))
                table.writerows(_rows(frame, columns))
                if frame.problem:
                    problems.append(frame.problem)
                film(frame)
                frames += 1
                faces += len(frame.faces)
                people |= set(frame.ids.tolist())
        taken = time.perf_counter() - begun
    if video.problem:
        problems.append(video.problem)
    report_problems(problems)
    say(
        f"frames: {frames}, people: {len(people)}, faces: {faces}, faces/s: {faces / taken:.1f}, model: {options.model}"
    )
    if replaced := replace_results(folder, _COMMAND, written, _settings(options)):
        say(replaced)
    written.append(MANIFEST)
    say(f"written: {', '.join(str(folder / name) for name in written)}")
    return 0 if faces else 1


def _settings(options: argparse.Namespace) -> dict[str, Any]:
    """What the results depend on; JSON values, called like the options."""
    fitting = Fitting(options.detector, given_search(options))
    names = ("model", "video", "detector", "redetect_every", "smooth", "unshift", "overlay", "heads")
    placing = given_placing(options)
    return {
        "jaxfit": jaxfit.__version__,
        **{name: getattr(options, name) for name in names},
        "placing": None if placing is None else placing.settings(),
        **vars(fitting.search),
        **file_digests(options.model, run_files(options.model, fitting)),
    }


@contextmanager
def _film(folder: Path | None, frame_rate: float) -> Iterator[Callable[[TrackedFrame], None]]:
    """What draws frames with their faces into ``overlay.webm``; without a folder nothing."""
    if folder is None:
        yield lambda frame: None
        return
    with write_video(folder / _OVERLAY, frame_rate) as write:
        yield lambda frame: write(_drawn(frame), frame.seconds)


def _drawn(frame: TrackedFrame) -> np.ndarray:
    """A frame with its faces and their numbers drawn over it."""
    canvas = frame.picture
    for number, box, row in zip(frame.ids, frame.faces.boxes, frame.faces.rows(), strict=True):
        canvas = draw_name(draw_row(canvas, row, frame.faces.scheme, boxed=False), str(number), box, row["ok"])
    return canvas


def _columns(model: Model, placed: bool) -> list[str]:
    """The columns of a face, as `Fits.to_dicts` calls them; without a confidence, its column is empty."""
    points = landmark_columns(model.scheme, confident=True, uncertain=model.uncertainty is not None)[3:]
    return ["ok", "confidence", *(name for name in points if name not in ("ok", "confidence"))] + (
        [] if model.space_3d is None else [f"{HEAD}{name}" for name in (*ANGLES, "scale", *(PLACE if placed else ()))]
    )


def _rows(frame: TrackedFrame, columns: list[str]) -> Iterator[list[object]]:
    for number, face in zip(frame.ids, frame.faces.to_dicts(), strict=True):
        numbers = [table_text(face[name]) if name in face else "" for name in columns]
        yield [frame.number, f"{frame.seconds:.3f}", number, *numbers]
