"""Pictures of turned heads: the poses that are drawn, labels that have them, and runs that go on where they were."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import ArrayLike
from script_runner import load, run

from jaxfit.data.pictures import read_image, write_image
from jaxfit.data.pts import read_pts, write_pts
from jaxfit.errors import InputError
from jaxfit.heads.facekit import read_facekit
from jaxfit.heads.model import load_head_model
from jaxfit.labels.datasets import read_dataset
from jaxfit.schemes.known import IBUG68
from jaxfit.shapes.alignment import align_head
from jaxfit.shapes.camera import Camera, pose_degrees, rotation_angles, rotation_matrix, show

SCRIPT = load("render_poses")
MODEL = load_head_model().of(IBUG68, 0.99)
ALIGN = jax.jit(align_head)
NAMES = ("anna_1", "anna_2", "bert")


def labels(pose: ArrayLike) -> np.ndarray:
    """The mean head's landmarks (68, 2) at a pose, in a picture of 260 x 240 pixels."""
    roll, pitch, yaw = np.deg2rad(np.asarray(pose))
    rotation = rotation_matrix(*map(jnp.asarray, (-roll, pitch, yaw)))
    camera = Camera(jnp.asarray(7.0), rotation, jnp.array([130.0, 130.0]), jnp.asarray(True))
    return np.asarray(show(MODEL.mean, camera), np.float64)[:, :2]


def pose_of(landmarks: np.ndarray) -> np.ndarray:
    found = ALIGN(MODEL, jnp.asarray(landmarks, jnp.float32))
    return np.asarray(pose_degrees(*rotation_angles(found.camera.rotation)))


@pytest.fixture
def faces(tmp_path: Path) -> Path:
    """A folder of faces: a smooth gradient with a bright spot on the tip of the nose."""
    folder = tmp_path / "people"
    folder.mkdir()
    for name, yaw in zip(NAMES, (20.0, -20.0, 3.0), strict=True):
        points = labels((5.0, 4.0, yaw))
        picture = np.tile(np.linspace(40, 120, 260).astype(np.uint8), (240, 1))
        x, y = np.round(points[30]).astype(int)
        picture[y - 2 : y + 3, x - 2 : x + 3] = 255
        write_image(folder / f"{name}.jpg", picture)
        write_pts(folder / f"{name}.pts", points)
    return folder


@pytest.fixture(scope="module")
def dense_head(shared_data: Path) -> Any:
    kit = shared_data / "ict" / "ict_facekit.npz"
    if not kit.is_file():
        pytest.skip("needs ICT-FaceKit in ../shared/data/ict")
    return SCRIPT.learn_dense_head(read_facekit(kit), MODEL)


@pytest.fixture
def render(faces: Path, dense_head: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """The command, on the faces; the dense head, which takes seconds, is learned once."""
    monkeypatch.setattr(SCRIPT, "read_facekit", lambda path: path)
    monkeypatch.setattr(SCRIPT, "learn_dense_head", lambda kit, model: dense_head)
    return lambda out, *more: run(
        "render_poses", "--facekit", "kit.npz", "--data", f"pts:{faces}", "--out", str(out), *more
    )


def test_heads_turn_further_to_the_side_they_look_to() -> None:
    rng = np.random.default_rng(0)
    for own in ((3.0, -5.0, 25.0), (0.0, 10.0, -70.0)):
        poses = np.array([SCRIPT.sideways(np.array(own), rng) for _ in range(400)])
        assert (np.abs(poses[:, 0] - own[0]) <= 10).all()
        assert (np.abs(poses[:, 1]) <= 55).all()
        assert 100 < (np.abs(poses[:, 1] - own[1]) > 8).sum() < 250
        yaws = poses[:, 2] * np.sign(own[2])
        low = max(30.0, abs(own[2]))
        assert low <= yaws.min() < low + 2
        assert 88 < yaws.max() <= 90
    # Of heads turned to both extremes there are fewer than if yaw and, in half of them, pitch were drawn evenly.
    poses = np.array([SCRIPT.sideways(np.zeros(3), rng) for _ in range(20000)])
    both = (np.abs(poses[:, 1]) > 45) & (np.abs(poses[:, 2]) > 80)
    assert 0 < both.mean() < 0.85 * (0.5 * 10 / 55) * (10 / 60)
    frontal = np.array([SCRIPT.sideways(np.zeros(3), rng)[2] for _ in range(100)])
    assert 25 < (frontal > 0).sum() < 75


def test_heads_tilt_further_the_way_they_look() -> None:
    rng = np.random.default_rng(0)
    poses = np.array([SCRIPT.tilted(np.array([3.0, -25.0, 20.0]), rng) for _ in range(400)])
    assert (np.abs(poses[:, 0] - 3) <= 10).all()
    assert (np.abs(poses[:, 2] - 20) <= 8).all()
    assert -55 <= poses[:, 1].min() < -53
    assert -27 < poses[:, 1].max() <= -25
    frontal = np.array([SCRIPT.tilted(np.zeros(3), rng)[1] for _ in range(200)])
    assert np.abs(frontal).min() >= 15
    assert 60 < (frontal > 0).sum() < 140
    with pytest.raises(InputError, match="already"):
        SCRIPT.tilted(np.array([0.0, 50.0, 0.0]), rng)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 88.0), (0.0, 60.0, 0.0)])
def test_faces_that_are_turned_already_are_left_out(pose: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="already"):
        SCRIPT.sideways(np.array(pose), np.random.default_rng(0))


def test_faces_are_spread_evenly_over_subjects(faces: Path) -> None:
    people = read_dataset(f"pts:{faces}").faces
    chosen = SCRIPT.chosen
    assert [face.face for face in chosen(people, 1, None)] == ["anna_2", "bert"]
    assert [face.face for face in chosen(people, None, 1)] == ["anna_2"]
    assert [face.face for face in chosen(people, None, 9)] == list(NAMES)
    assert chosen(people, None, 0) == []


def test_the_dense_head_follows_the_landmarks(dense_head: Any) -> None:
    # A vertex of the mesh lies where its landmark does, for the mean and for every mode.
    mean, modes = np.asarray(MODEL.mean), np.asarray(MODEL.modes) * np.asarray(MODEL.deviations)[:, None, None]
    nearest = np.linalg.norm(dense_head.mean[None] - mean[:, None], axis=2)
    # Landmarks may lie between vertices, which are some millimetres apart.
    assert nearest.min(1).max() < 0.3
    followed = dense_head.modes[:, nearest.argmin(1)] * np.asarray(MODEL.deviations)[:, None, None]
    apart = np.linalg.norm((followed - modes)[:10], axis=(1, 2)) / np.linalg.norm(modes[:10], axis=(1, 2))
    assert apart.max() < 0.25


def test_rendered_labels_have_the_pose_that_was_drawn(render: Callable[..., int], faces: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert render(out, "--seed", "3") == 0
    dataset = read_dataset(f"pts:{out}")
    assert not dataset.problems
    assert [face.face for face in dataset.faces] == [f"people_{name}" for name in NAMES]
    assert [face.subject for face in dataset.faces] == ["people_anna", "people_anna", "people_bert"]
    for face, name in zip(dataset.faces, NAMES, strict=True):
        own = pose_of(read_pts(faces / f"{name}.pts"))
        target = SCRIPT.sideways(own, SCRIPT.generator(3, face.face))
        np.testing.assert_allclose(pose_of(face.landmarks), target, atol=2)
        # The nose, at the picture's front whatever the pose, took its bright spot along.
        picture = read_image(face.image)
        x, y = np.round(face.landmarks[30]).astype(int)
        assert picture.shape == (288, 288, 3)
        assert picture[y - 4 : y + 5, x - 4 : x + 5].max() > 200


def test_runs_go_on_where_they_were(
    render: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert render(out, "--most", "1") == 0
    (first,) = out.glob("*.pts")
    before = first.stat().st_mtime_ns
    assert render(out) == 0
    assert "3 of 3 faces rendered" in capsys.readouterr().out
    assert first.stat().st_mtime_ns == before
    whole = tmp_path / "whole"
    assert render(whole) == 0
    for path in whole.glob("*_*"):
        assert (out / path.name).read_bytes() == path.read_bytes()
    assert render(out, "--seed", "1") == 2
    assert "other settings (seed: 0 there, 1 here)" in capsys.readouterr().err


def test_labels_that_no_head_has_are_reported(
    render: Callable[..., int], faces: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = read_pts(faces / "bert.pts")
    write_pts(faces / "bert.pts", np.random.default_rng(0).permutation(points))
    assert render(tmp_path / "out") == 0
    printed = capsys.readouterr()
    assert "people_bert: left out: the head model lies" in printed.err
    assert "2 of 3 faces rendered" in printed.out
    assert not list((tmp_path / "out").glob("people_bert.*"))
