"""Videos: frames from files and cameras, one at a time, and files of frames written whole or not at all."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import cv2
import numpy as np

from jaxfit.data.containers import is_cut
from jaxfit.data.limits import size_problem
from jaxfit.data.outputs import atomic_path
from jaxfit.data.pictures import Pixels, quiet, to_eight_bits
from jaxfit.errors import ImageError, InputError

DEFAULT_FRAME_RATE = 30.0  # frames a second, of what does not say
# What OpenCV's wheels bring everywhere: MPEG-4 part 2, which browsers do not play, and VP8, which they do.
_CODECS = {".mp4": "mp4v", ".webm": "VP80"}
# Containers that count by estimate are some frames off: where less than this came it is looked into.
_WHOLE = 0.95
_DECODED = 0.9  # of the packets of a file in order: some have no frame of their own
_LONGEST = 600.0  # seconds for which a frame stands at most: damaged time stamps make no film of days


class VideoFrame(NamedTuple):
    """One picture of a video.

    Attributes:
        number: from 0.
        seconds: since the first frame, or of a camera since its first frame came.
        picture: uint8 (H, W, 3) RGB, upright as the file's rotation says.
    """

    number: int
    seconds: float
    picture: np.ndarray


class Video:
    """The frames of a video file or camera, one after another, once; close it, or use it in a ``with`` block.

    Attributes:
        name: the file's path, or ``camera N``.
        live: whether it is a camera, which does not end by itself.
        frame_rate: frames a second, as the file or camera says, else 30.
        count: how many frames there are, from the file's duration and mean rate, which is only an estimate for files of
            a variable rate; 0 if unknown.
        problem: known once all frames have come: that the file was cut short, or that frames cannot be decoded; None if
            it is whole.

    Args:
        source: a video file, or the number of a camera.

    Raises:
        InputError: there is no such file or camera, or no frame of it can be read.
    """

    def __init__(self, source: str | Path | int):
        self.live = isinstance(source, int)
        self.name = f"camera {source}" if self.live else str(source)
        if not isinstance(source, int) and Path(source).is_dir():
            raise InputError(
                f"expected a video file or the number of a camera; {source} is a folder: name one of its videos, or "
                "fit its pictures (jaxfit fit, jaxfit.fit)"
            )
        if not isinstance(source, int) and not Path(source).is_file():
            raise InputError(f"expected a video file or the number of a camera; there is no file {source}")
        with _quiet_codecs():
            self._capture = cv2.VideoCapture(source if isinstance(source, int) else str(source))
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
            size = (self._capture.get(side) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            too_large = size_problem(*map(int, size)) if self._capture.isOpened() else None
            self._next = self._capture.read()[1] if self._capture.isOpened() and too_large is None else None
        if too_large is not None:
            self.close()
            raise InputError(f"{self.name}: {too_large}")
        if self._next is None:
            self.close()
            raise InputError(
                f"{self.name}: it cannot be opened; is it connected, and free?"
                if self.live
                else f"{self.name}: not a video that OpenCV reads, or damaged: no frame of it can be read"
            )
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        self.frame_rate = float(rate) if 0 < rate < 1000 else DEFAULT_FRAME_RATE
        self.count = 0 if self.live else max(0, int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        self.problem: str | None = None

    def __iter__(self) -> Iterator[VideoFrame]:
        number, seconds, first = 0, 0.0, self._clock()
        while self._next is not None:
            if number:
                now = self._clock() - first
                # Files without time stamps, or with wrong ones, have their frames at even distances.
                seconds = now if now > seconds else seconds + 1 / self.frame_rate
            yield VideoFrame(number, seconds, cv2.cvtColor(self._next, cv2.COLOR_BGR2RGB))
            with quiet():
                self._next = self._capture.read()[1]
            number += 1
        if self.live:
            self.problem = f"{self.name}: no more frames came after {number}"
        elif expected := self._missed(number):
            self.problem = f"{self.name}: damaged or cut short: {number} of {expected} frames could be read"

    def _clock(self) -> float:
        """When the frame was taken that was read last, in seconds."""
        return time.monotonic() if self.live else self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000

    def _missed(self, number: int) -> int:
        """How many frames there should be in a file of which fewer came; 0 if it is whole.

        That fewer came than the file says proves nothing: their number is mostly made of a duration and a mean rate.
        """
        if number >= _WHOLE * self.count:
            return 0
        packets = _packets(self.name)
        if number < _DECODED * packets:
            return packets
        # The time of the last frame, in frames of the mean rate: also of files whose time does not begin at 0.
        reached = self._capture.get(cv2.CAP_PROP_PTS) + 1
        return self.count if reached < _WHOLE * self.count and is_cut(self.name) else 0

    def __enter__(self) -> "Video":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, or release the camera."""
        self._capture.release()


@contextmanager
def write_video(path: str | Path, frame_rate: float) -> Iterator[Callable[..., None]]:
    """What takes frames, and makes a video of them.

    It is called with a frame, a picture as in `jaxfit.data.pictures.to_eight_bits`, all as large as the first, and with
    the ``seconds`` when it is shown; the first begins the video. Without them a frame follows its forerunner. The
    video has a constant rate: frames are repeated until the next one's time, or left out where several come at a time.
    The file appears under its name when the block ends, and not if the block raises or gives no frame. A last row or
    column of an odd number is left out, as the codec has it.

    Args:
        path: ends in ``.webm``, for what browsers play, or in ``.mp4``, for MPEG-4 part 2, which they do not.
        frame_rate: frames a second.

    Raises:
        InputError: another name, a rate that is not positive, a missing folder, or a frame of another size.
        ImageError: no such picture; or OpenCV cannot write such frames, or could not write them all, as when the disk
            is full.
    """
    if Path(path).suffix.lower() not in _CODECS:
        raise InputError(f"cannot write {path}: expected a name ending in {' or '.join(_CODECS)}")
    if not 0 < frame_rate < 1000:
        raise InputError(f"expected a frame rate between 0 and 1000 a second; got {frame_rate}")
    with atomic_path(path) as temporary:
        film = _Film(path, temporary, frame_rate)
        try:
            yield film.write
            film.end()
        finally:
            film.close()
        # OpenCV says nothing of a full disk.
        with quiet():
            there = int(cv2.VideoCapture(str(temporary)).get(cv2.CAP_PROP_FRAME_COUNT)) if film.written else 0
        if not film.written or there < _WHOLE * film.written - 1 or is_cut(temporary):
            raise ImageError(
                f"{path}: {max(0, there)} of {film.written} frames were written: no frame came, or the disk is full"
            )


class _Film:
    """A video that is written, at a constant rate.

    Attributes:
        written: frames, repeated ones included.
    """

    def __init__(self, path: str | Path, temporary: Path, frame_rate: float):
        self._path, self._temporary, self._rate = path, temporary, frame_rate
        self._writer: cv2.VideoWriter | None = None
        self._shape: tuple[int, ...] = ()
        self._waiting: np.ndarray | None = None  # the last frame, until it is known how long it stands
        self._shown = 0  # the number of the frame at which it begins
        self._first = 0.0
        self.written = 0

    def write(self, picture: Pixels, seconds: float | None = None) -> None:
        """Take a frame that is shown at this time, in seconds."""
        picture = to_eight_bits(picture)
        if self._waiting is None:
            self._shape, self._first = picture.shape[:2], seconds or 0.0
        if picture.shape[:2] != self._shape:
            raise InputError(f"expected frames of one size, {self._shape}; got {picture.shape[:2]}")
        if self._waiting is not None:
            most = self._shown + round(_LONGEST * self._rate)
            now = self._shown + 1 if seconds is None else round((seconds - self._first) * self._rate)
            now = min(max(now, self._shown), most)
            self._put(now - self._shown)
            self._shown = now
        self._waiting = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR if picture.ndim == 2 else cv2.COLOR_RGB2BGR)

    def end(self) -> None:
        """Write the last frame, too."""
        if self._waiting is not None:
            self._put(1)

    def close(self) -> None:
        """Write the file's end."""
        if self._writer is not None:
            self._writer.release()

    def _put(self, times: int) -> None:
        for _ in range(times):
            if self._writer is None:
                codec = cv2.VideoWriter.fourcc(*_CODECS[Path(self._path).suffix.lower()])
                size = (self._shape[1], self._shape[0])
                with _quiet_codecs(), _mute():
                    self._writer = cv2.VideoWriter(str(self._temporary), codec, self._rate, size)
                if not self._writer.isOpened():
                    raise ImageError(f"{self._path}: OpenCV cannot write videos of {size[0]} x {size[1]} pixels here")
            assert self._waiting is not None
            self._writer.write(self._waiting)
            self.written += 1


def _packets(path: str) -> int:
    """How many frames are stored in a file, whether they can be decoded or not."""
    with _quiet_codecs():
        capture = cv2.VideoCapture(path)
        capture.set(cv2.CAP_PROP_FORMAT, -1)  # what is stored, as it is
        count = 0
        while capture.grab():
            count += 1
        capture.release()
    return count


@contextmanager
def _mute() -> Iterator[None]:
    """Without the standard error: OpenCV complains there, and not in its log, of WebM having no code for its codecs."""
    try:
        kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:  # it is closed
        yield
        return
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@contextmanager
def _quiet_codecs() -> Iterator[None]:
    """A problem is reported once, with the file's name; FFmpeg, which OpenCV takes, would print its own account."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the process opens its first video
    with quiet():
        yield
