"""Reading and writing videos: what comes back, and what is said of files that are none."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

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


def test_written_videos_are_read_again(tmp_path: Path) -> None:
    frames = [np.full((40, 60, 3), 20 * number, np.uint8) for number in range(8)]
    with write_video(tmp_path / "out.mp4", 10.0) as write:
        for frame in frames:
            write(frame)
        assert not (tmp_path / "out.mp4").exists()
    with Video(tmp_path / "out.mp4") as video:
        assert video.frame_rate == 10.0
        levels = [frame.picture.mean() for frame in video]
    np.testing.assert_allclose(levels, 20 * np.arange(8), atol=4)
    assert [path.name for path in tmp_path.iterdir()] == ["out.mp4"]


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
    with pytest.raises(InputError, match="there is no file"):
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
    code = "import contextlib, jaxfit, sys\nwith contextlib.suppress(jaxfit.InputError): jaxfit.data.Video(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "half.mp4"], capture_output=True, check=True)
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
        ("out.avi", 25.0, "a name ending in .mp4"),
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
