"""Where labels lie beside what they mark, measured on drawn faces whose labels are known to be off."""

from pathlib import Path

import numpy as np
import pytest
from script_runner import run

from jaxfit.data.pictures import write_image
from jaxfit.data.pts import write_pts
from jaxfit.heads.model import load_head_model
from jaxfit.schemes.known import IBUG68

FACE = np.asarray(load_head_model().of(IBUG68, 0.5).mean)[:, :2]


def draw(folder: Path, number: int, shift: float) -> None:
    """A picture with a symmetric face of blobs, a little turned, and labels that lie right of them by ``shift``."""
    rng = np.random.default_rng(number)
    angle = rng.normal(0, 0.06)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    symmetric = (FACE + FACE[np.array(IBUG68.mirror)] * [-1, 1]) / 2
    points = 6.3 * symmetric @ turn.T + rng.uniform(95, 105, 2)
    rows, columns = np.mgrid[:200, :200]
    picture = 120 + rng.normal(0, 4, (200, 200))
    for x, y in points:
        picture += 20 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18)
    write_image(folder / f"{number}.png", np.repeat(picture.clip(0, 255).astype(np.uint8)[..., None], 3, 2))
    write_pts(folder / f"{number}.pts", points + [shift, shift])


@pytest.mark.parametrize("shift", [0.0, 1.0, -1.7])
def test_shifts_of_labels_are_found(tmp_path: Path, shift: float) -> None:
    faces = tmp_path / "faces"
    faces.mkdir()
    for number in range(4):
        draw(faces, number, shift)
    out = tmp_path / "shift.md"
    assert run("label_shift", "--data", f"pts:{faces}", "--report", str(out)) == 0
    name, count, _, found, _ = (cell.strip() for cell in out.read_text().splitlines()[-2].strip("| ").split("|"))
    assert (name, count) == ("faces", "4")
    assert float(found) == pytest.approx(shift, abs=0.15)


def test_faces_that_do_not_look_at_the_camera_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    draw(tmp_path, 0, 0.0)
    profile = np.stack([np.maximum(FACE[:, 0], 0), FACE[:, 1]], 1) * 6 + 100
    write_pts(tmp_path / "0.pts", profile)
    assert run("label_shift", "--data", f"pts:{tmp_path}") == 2
    assert "expected two faces or more that look at the camera" in capsys.readouterr().err
