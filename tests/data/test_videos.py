"""Reading and writing videos: what comes back, and what is said of files that are none."""

import re
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from jaxfit.data.containers import is_cut
from jaxfit.data.videos import Video, write_video
from jaxfit.errors import ImageError, InputError


def film(path: Path, count: int = 12, codec: str = "mp4v", rate: float = 25.0) -> list[np.ndarray]:
    """Frames (48, 64, 3) RGB with a red left half that grow brighter, written by OpenCV."""
    frames = [np.full((48, 64, 3), 10 * number, np.uint8) for number in range(count)]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate, (64, 48))
    for frame in frames:
        frame[:, :32, 0] = 200
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
    return frames


def test_frames_come_in_order_with_their_times(tmp_path: Path) -> None:
    frames = film(tmp_path / "film.mp4")
    with Video(tmp_path / "film.mp4") as video:
        read = list(video)
    assert (video.frame_rate, video.count, video.problem) == (25.0, 12, None)
    assert [frame.number for frame in read] == list(range(12))
    np.testing.assert_allclose([frame.seconds for frame in read], np.arange(12) / 25, atol=1e-6)
    for frame, truth in zip(read, frames, strict=True):
        assert frame.picture.shape == (48, 64, 3)
        assert np.abs(frame.picture.astype(int) - truth)[:, 8:24].mean() < 10  # RGB, not BGR


@pytest.mark.parametrize("name", ["out.mp4", "out.webm"])
def test_written_videos_are_read_again(tmp_path: Path, name: str) -> None:
    frames = [np.full((40, 60, 3), 20 * number, np.uint8) for number in range(8)]
    with write_video(tmp_path / name, 10.0) as write:
        for frame in frames:
            write(frame)
        assert not (tmp_path / name).exists()
    with Video(tmp_path / name) as video:
        assert video.frame_rate == 10.0
        levels = [frame.picture.mean() for frame in video]
    np.testing.assert_allclose(levels, 20 * np.arange(8), atol=4)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    ("times", "levels"),
    [
        ([0.0, 0.1, 0.2], [0, 1, 2]),
        ([7.0, 7.3, 7.4], [0, 0, 0, 1, 2]),  # that it begins late does not matter; what stands longer is repeated
        ([0.0, 0.1, 0.12, 0.14, 0.2], [0, 3, 4]),  # of several at one time the last is seen
        ([0.0, 0.2, 0.1, 0.3], [0, 0, 2, 3]),  # time does not go back
        ([None, None, None], [0, 1, 2]),
    ],
)
def test_written_frames_stand_until_the_next(tmp_path: Path, times: list, levels: list[int]) -> None:
    with write_video(tmp_path / "out.webm", 10.0) as write:
        for number, seconds in enumerate(times):
            write(np.full((48, 64), 50 * number, np.uint8), seconds)
    with Video(tmp_path / "out.webm") as video:
        read = [frame.picture.mean() for frame in video]
    np.testing.assert_allclose(read, 50 * np.array(levels), atol=5)


def retimed(data: bytes, stamps: list[int], duration: float) -> bytes:
    """A WebM file of one cluster whose frames come at other times, in milliseconds, and that says how long it is."""
    file, place = bytearray(data), data.index(b"\x44\x89\x88") + 3
    file[place : place + 8] = struct.pack(">d", duration)
    blocks = [found.end() for found in re.finditer(rb"\xa3[\x80-\xff]\x81(?=..[\x00\x80])", data, re.DOTALL)]
    for place, stamp in zip(blocks, stamps, strict=True):
        file[place : place + 2] = struct.pack(">h", stamp)
    return bytes(file)


@pytest.mark.parametrize(
    ("stamps", "duration"),
    [
        ([0, 40, 80, 500, 540, 1500, 1540, 1580, 3000, 3040, 6000, 6040], 6080.0),  # a variable rate
        ([10_000 + 40 * number for number in range(12)], 10_480.0),  # a start that is not 0
        ([40 * number for number in range(12)], 9000.0),  # sound that goes on
    ],
    ids=["variable", "offset", "sound"],
)
def test_intact_films_are_called_so_whatever_their_containers_say(
    tmp_path: Path, stamps: list[int], duration: float
) -> None:
    film(tmp_path / "even.webm", codec="VP80")
    (tmp_path / "film.webm").write_bytes(retimed((tmp_path / "even.webm").read_bytes(), stamps, duration))
    with Video(tmp_path / "film.webm") as video:
        seconds = [frame.seconds for frame in video]
    assert video.count > 13  # an estimate
    assert video.problem is None
    np.testing.assert_allclose(seconds, (np.array(stamps) - stamps[0]) / 1000, atol=2e-3)


@pytest.mark.parametrize(("name", "codec"), [("film.webm", "VP80"), ("film.avi", "MJPG"), ("film.mkv", "MJPG")])
def test_cut_and_damaged_films_are_called_so(tmp_path: Path, name: str, codec: str) -> None:
    film(tmp_path / name, count=25, codec=codec)
    data = (tmp_path / name).read_bytes()
    half = len(data) // 2
    for damaged in (data[:half], data[:half] + bytes(len(data) - half)):
        (tmp_path / name).write_bytes(damaged)
        with Video(tmp_path / name) as video:
            count = sum(1 for _ in video)
        assert 0 < count < 24
        assert f"{count} of " in (video.problem or "")
    (tmp_path / name).write_bytes(data)
    assert not is_cut(tmp_path / name)


def test_browsers_play_what_is_written(tmp_path: Path, browser: Any) -> None:
    with write_video(tmp_path / "out.webm", 10.0) as write:
        for number in range(20):
            write(np.full((48, 64, 3), 10 * number, np.uint8))
    page = browser.new_page()
    (tmp_path / "page.html").write_text('<video src="out.webm" muted></video>')
    page.goto((tmp_path / "page.html").as_uri())
    play = "video => video.play().then(() => [video.duration, video.videoWidth, video.videoHeight])"
    duration, *size = page.eval_on_selector("video", play)
    assert size == [64, 48]
    assert abs(duration - 2.0) < 0.11
    page.close()


def test_a_writer_that_is_stopped_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "out.mp4").write_bytes(b"before")
    with pytest.raises(KeyboardInterrupt), write_video(tmp_path / "out.mp4", 10.0) as write:  # noqa: PT012
        write(np.zeros((40, 60, 3), np.uint8))
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["out.mp4"]
    assert (tmp_path / "out.mp4").read_bytes() == b"before"


def test_turned_videos_come_upright(tmp_path: Path) -> None:
    film(tmp_path / "film.mp4")
    data = bytearray((tmp_path / "film.mp4").read_bytes())
    matrix = data.index(b"tkhd") + 44  # of the track's header: how to turn what is shown
    assert data[matrix : matrix + 4] == b"\x00\x01\x00\x00"
    # A quarter turn clockwise: x' = -y, y' = x, in fixed-point numbers.
    data[matrix : matrix + 36] = np.array([0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30], ">i4").tobytes()
    (tmp_path / "turned.mp4").write_bytes(data)
    with Video(tmp_path / "turned.mp4") as video:
        first = next(iter(video)).picture
    assert first.shape == (64, 48, 3)
    red = first[..., 0].astype(int) - first[..., 1]
    assert red[:28].min() > 100  # the left half is on top
    assert red[36:].max() < 100


def test_of_a_file_that_was_cut_short_what_is_there_is_read(tmp_path: Path) -> None:
    film(tmp_path / "whole.avi", codec="MJPG")
    data = (tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) * 3 // 4])
    with Video(tmp_path / "cut.avi") as video:
        count = sum(1 for _ in video)
    assert 0 < count < 12
    assert video.problem is not None
    assert f"{count} of 12 frames" in video.problem
    assert "cut.avi" in video.problem


def test_files_that_are_no_videos(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no file"):
        Video(tmp_path / "missing.mp4")
    with pytest.raises(InputError, match="is a folder: name one of its videos, or fit its pictures"):
        Video(tmp_path)
    film(tmp_path / "film.mp4")
    (tmp_path / "half.mp4").write_bytes((tmp_path / "film.mp4").read_bytes()[:400])
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "empty.mp4").touch()
    for name in ("half.mp4", "text.mp4", "empty.mp4"):
        with pytest.raises(InputError, match=f"{name}: not a video that OpenCV reads"):
            Video(tmp_path / name)


def test_codecs_hold_their_tongues(tmp_path: Path) -> None:
    film(tmp_path / "film.mp4")
    (tmp_path / "half.mp4").write_bytes((tmp_path / "film.mp4").read_bytes()[:400])
    code = """import contextlib, jaxfit, numpy, sys
with contextlib.suppress(jaxfit.InputError): jaxfit.data.Video(sys.argv[1])
with jaxfit.data.videos.write_video(sys.argv[2], 10.0) as write: write(numpy.zeros((48, 64), numpy.uint8))"""
    arguments = [sys.executable, "-c", code, str(tmp_path / "half.mp4"), str(tmp_path / "out.webm")]
    done = subprocess.run(arguments, capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_a_camera_that_is_not_there() -> None:
    with pytest.raises(InputError, match="camera 97: it cannot be opened"):
        Video(97)


class _Camera:
    """Stands in for OpenCV's capture: three frames, then unplugged."""

    def __init__(self, source: int):
        self.left = 3

    def isOpened(self) -> bool:
        return True

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.left -= 1
        return (True, np.zeros((4, 6, 3), np.uint8)) if self.left >= 0 else (False, None)

    def get(self, what: int) -> float:
        return 0.0

    def set(self, what: int, value: float) -> bool:
        return False

    def release(self) -> None:
        pass


def test_a_camera_keeps_the_clocks_time_and_says_when_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", _Camera)
    with Video(0) as video:
        assert video.live
        seconds = [frame.seconds for frame in video]
    assert len(seconds) == 3
    assert seconds[0] == 0
    assert (np.diff(seconds) > 0).all()
    assert video.problem == "camera 0: no more frames came after 3"


def test_what_cannot_be_written(tmp_path: Path) -> None:
    for path, rate, expected in (
        ("out.avi", 25.0, "a name ending in .mp4 or .webm"),
        ("out.mp4", 0.0, "a frame rate"),
        ("missing/out.mp4", 25.0, "does not exist"),
    ):
        with pytest.raises(InputError, match=expected), write_video(tmp_path / path, rate):
            pass
    with pytest.raises(InputError, match="frames of one size"), write_video(tmp_path / "out.mp4", 25.0) as write:  # noqa: PT012
        write(np.zeros((40, 60), np.uint8))
        write(np.zeros((40, 62), np.uint8))
    with pytest.raises(ImageError, match="no frame came"), write_video(tmp_path / "out.mp4", 25.0):
        pass
    assert not list(tmp_path.iterdir())
