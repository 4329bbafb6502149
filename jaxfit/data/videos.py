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

from jaxfit.data.outputs import atomic_path
from jaxfit.data.pictures import Pixels, quiet, to_eight_bits
from jaxfit.errors import ImageError, InputError

VIDEO_SUFFIX = ".mp4"
DEFAULT_FRAME_RATE = 30.0  # frames a second, of what does not say
_CODEC = "mp4v"  # MPEG-4 part 2: OpenCV's wheels bring it everywhere, unlike H.264
# Containers that count by estimate are some frames off; a file that ends earlier than this was cut.
_WHOLE = 0.95


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
        count: how many frames the file says it has; 0 if nobody knows.
        problem: once the frames have come, why there were fewer than the file says; None if there is none.

    Args:
        source: a video file, or the number of a camera.

    Raises:
        InputError: there is no such file or camera, or no frame of it can be read.
    """

    def __init__(self, source: str | Path | int):
        self.live = isinstance(source, int)
        self.name = f"camera {source}" if self.live else str(source)
        if not isinstance(source, int) and not Path(source).is_file():
            raise InputError(f"expected a video file or the number of a camera; there is no file {source}")
        with _quiet_codecs():
            self._capture = cv2.VideoCapture(source if isinstance(source, int) else str(source))
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
            self._next = self._capture.read()[1] if self._capture.isOpened() else None
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
        number, seconds, first = 0, 0.0, time.monotonic()
        while self._next is not None:
            if number:
                now = time.monotonic() - first if self.live else self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                # Files without time stamps, or with wrong ones, have their frames at even distances.
                seconds = now if now > seconds else seconds + 1 / self.frame_rate
            yield VideoFrame(number, seconds, cv2.cvtColor(self._next, cv2.COLOR_BGR2RGB))
            with quiet():
                self._next = self._capture.read()[1]
            number += 1
        if self.live:
            self.problem = f"{self.name}: no more frames came after {number}"
        elif number < _WHOLE * self.count:
            self.problem = f"{self.name}: damaged or cut short: {number} of {self.count} frames could be read"

    def __enter__(self) -> "Video":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the file or camera back."""
        self._capture.release()


@contextmanager
def write_video(path: str | Path, frame_rate: float) -> Iterator[Callable[[Pixels], None]]:
    """What takes frames, as `jaxfit.data.pictures.to_eight_bits`, all as large as the first, and makes a video of them.

    The file appears under its name when the block ends, and not if the block raises or gives no frame. A last row or
    column of an odd number is left out, as the codec has it.

    Args:
        path: ends in ``.mp4``.
        frame_rate: frames a second.

    Raises:
        InputError: another name, a rate that is not positive, a missing folder, or a frame of another size.
        ImageError: no such picture; or OpenCV cannot write such frames, or could not write them all, as when the disk
            is full.
    """
    if Path(path).suffix.lower() != VIDEO_SUFFIX:
        raise InputError(f"cannot write {path}: expected a name ending in {VIDEO_SUFFIX}")
    if not 0 < frame_rate < 1000:
        raise InputError(f"expected a frame rate between 0 and 1000 a second; got {frame_rate}")
    with atomic_path(path) as temporary:
        writer: cv2.VideoWriter | None = None
        shape: tuple[int, ...] = ()
        written = 0

        def write(picture: Pixels) -> None:
            nonlocal writer, shape, written
            picture = to_eight_bits(picture)
            if writer is None:
                shape = picture.shape[:2]
                with _quiet_codecs():
                    writer = cv2.VideoWriter(str(temporary), _codec(), frame_rate, (shape[1], shape[0]))
                if not writer.isOpened():
                    raise ImageError(f"{path}: OpenCV cannot write videos of {shape[1]} x {shape[0]} pixels here")
            if picture.shape[:2] != shape:
                raise InputError(f"expected frames of one size, {shape}; got {picture.shape[:2]}")
            writer.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR if picture.ndim == 2 else cv2.COLOR_RGB2BGR))
            written += 1

        try:
            yield write
        finally:
            if writer is not None:
                writer.release()
        # OpenCV says nothing of a full disk.
        with quiet():
            there = int(cv2.VideoCapture(str(temporary)).get(cv2.CAP_PROP_FRAME_COUNT)) if written else 0
        if not written or there < written:
            raise ImageError(f"{path}: {there} of {written} frames were written: no frame came, or the disk is full")


@contextmanager
def _quiet_codecs() -> Iterator[None]:
    """A problem is reported once, with the file's name; FFmpeg, which OpenCV takes, would print its own account."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the process opens its first video
    with quiet():
        yield


def _codec() -> int:
    return cv2.VideoWriter.fourcc(*_CODEC)
