"""``jaxfit track``: what it writes, what it prints, and what it leaves when it is stopped."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from csv_files import read_csv
from drawn_faces import draw_face

import jaxfit
from jaxfit.cli import track
from jaxfit.cli.main import main
from jaxfit.data.detectors import DETECTORS, Detection, DetectorEntry
from jaxfit.data.videos import Video, write_video
from jaxfit.fitting.track import TrackedFrame
from jaxfit.models.model import SQUARE, Model


class Middle:
    """A detector of faces in the middle of the picture, as drawn ones are."""

    kinds = (SQUARE,)
    rough = False
    colour = False

    def __call__(self, image: np.ndarray) -> list[Detection]:
        return [Detection(np.array([40.0, 43.0, 40.0, 40.0]), SQUARE)]


@pytest.fixture(autouse=True)
def _drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DETECTORS, "drawn", DetectorEntry(lambda search: Middle(), ("square",)))


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten frames of a drawn face, in the middle, where ``--detector drawn`` sees one."""
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    picture, _ = draw_face(np.random.default_rng(3))
    with write_video(path, 25.0) as write:
        for number in range(10):
            write(np.roll(picture, number % 3, 1))
    return path


def test_faces_and_overlay_are_written(
    film: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = ["--model", str(drawn_model), "--detector", "drawn"]
    assert main(["track", str(film), *whole, "--overlay", "--out", str(tmp_path / "out")]) == 0
    rows = read_csv(tmp_path / "out" / "faces.csv")
    assert [int(row["frame"]) for row in rows] == list(range(10))
    np.testing.assert_allclose([float(row["seconds"]) for row in rows], np.arange(10) / 25, atol=1e-3)
    assert {row["id"] for row in rows} == {"1"}
    with Video(film) as video:
        faces = [frame.faces[0] for frame in jaxfit.track(jaxfit.load(str(drawn_model)), video, detector="drawn")]
    xs = np.array([[float(row[f"x{i}"]) for i in range(1, 6)] for row in rows])
    np.testing.assert_allclose(xs, [face.landmarks[0, :, 0] for face in faces], atol=1e-3)
    widths = np.array([float(row["width"]) for row in rows])
    np.testing.assert_allclose(widths, [face.boxes[0, 2] for face in faces], atol=1e-3)
    with Video(tmp_path / "out" / "overlay.webm") as overlay:
        pictures = [frame.picture for frame in overlay]
    assert len(pictures) == 10
    cyan = (pictures[5][..., 1].astype(int) - pictures[5][..., 0]) > 60
    assert cyan.sum() > 5
    assert "frames: 10, people: 1, faces: 10, faces/s: " in capsys.readouterr().out


def test_smooth_smooths_and_says_what_it_replaced(
    film: Path, drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shaken = []
    for more, replaced in (([], ""), (["--smooth"], "with other settings (smooth: no there, yes here)")):
        arguments = ["--model", str(drawn_model), "--detector", "drawn", "--out", str(tmp_path), *more]
        assert main(["track", str(film), *arguments]) == 0
        said = capsys.readouterr().out
        assert replaced in said
        assert (f"replaced what `jaxfit track` wrote to {tmp_path}" in said) == bool(replaced)
        xs = np.array([float(row["x1"]) for row in read_csv(tmp_path / "faces.csv")])
        shaken.append(np.abs(np.diff(xs, 2)).mean())
        assert not (tmp_path / "overlay.webm").exists()
    assert shaken[1] < 0.9 * shaken[0]


def test_heads_have_their_pose(film: Path, head_models: dict[str, Model], tmp_path: Path) -> None:
    jaxfit.save(head_models["regression3d"], tmp_path / "head.safetensors")
    arguments = ["--model", str(tmp_path / "head.safetensors"), "--detector", "drawn", "--overlay"]
    assert main(["track", str(film), *arguments, "--out", str(tmp_path / "out")]) in (0, 1)
    with open(tmp_path / "out" / "faces.csv", encoding="utf-8") as file:
        assert file.readline().rstrip().endswith(",roll,pitch,yaw,scale")
    before_camera = [*arguments[:-1], "--field-of-view", "60", "--pupil-distance", "60"]
    assert main(["track", str(film), *before_camera, "--out", str(tmp_path / "placed")]) in (0, 1)
    with open(tmp_path / "placed" / "faces.csv", encoding="utf-8") as file:
        place = [f"{what}_{axis}" for what in ("position", "rotation") for axis in "xyz"]
        assert file.readline().rstrip().split(",")[-7:] == ["scale", *place]


def test_a_stopped_run_leaves_nothing_half_written(
    film: Path, drawn_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = track._drawn
    frames: list[TrackedFrame] = []

    def stop(frame: TrackedFrame) -> np.ndarray:
        frames.append(frame)
        if len(frames) == 4:
            raise KeyboardInterrupt
        return drawn(frame)

    monkeypatch.setattr(track, "_drawn", stop)
    arguments = ["--model", str(drawn_model), "--detector", "drawn", "--overlay", "--out", str(tmp_path)]
    assert main(["track", str(film), *arguments]) == 130
    assert list(tmp_path.iterdir()) == []


def test_a_camera_is_stopped_by_the_keyboard_and_keeps_what_it_saw(
    drawn_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture, _ = draw_face(np.random.default_rng(3))

    class Camera:
        def __init__(self, source: int):
            self.left = 6

        def isOpened(self) -> bool:
            return True

        def read(self) -> tuple[bool, np.ndarray]:
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            return True, picture

        def get(self, what: int) -> float:
            return 0.0

        def set(self, what: int, value: float) -> bool:
            return False

        def release(self) -> None:
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    assert main(["track", "0", "--model", str(drawn_model), "--detector", "drawn", "--out", str(tmp_path)]) == 0
    assert len(read_csv(tmp_path / "faces.csv")) == 6


def test_bad_input(drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    for name, expected in (("missing.mp4", "there is no file"), ("text.mp4", "not a video that OpenCV reads")):
        video = str(tmp_path / name)
        assert main(["track", video, "--model", str(drawn_model), "--out", str(tmp_path / "out")]) == 2
        assert expected in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_video_without_faces_and_one_that_was_cut_short(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "whole.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (160, 120))
    for _ in range(12):
        writer.write(np.random.default_rng(0).integers(0, 40, (120, 160, 3), np.uint8))
    writer.release()
    data = (tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) // 2])
    assert main(["track", str(tmp_path / "cut.avi"), "--model", "fast68", "--out", str(tmp_path / "out")]) == 1
    assert read_csv(tmp_path / "out" / "faces.csv") == []
    assert "damaged or cut short" in capsys.readouterr().err
