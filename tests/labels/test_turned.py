"""Pictures that EXIF data turn: labels belong to what is seen, unless their dataset says otherwise."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from csv_files import write_boxes
from drawn_faces import draw_face
from exif_files import TURNS, oriented, stored

from jaxfit.cli.main import main
from jaxfit.data.boxes import bounding_square
from jaxfit.data.pts import read_pts, write_pts
from jaxfit.labels import turned
from jaxfit.labels.datasets import read_dataset
from jaxfit.labels.records import FaceRecord
from jaxfit.labels.turned import seen_points
from jaxfit.runs import FolderRun, fit_folder
from jaxfit.schemes.known import IBUG68
from jaxfit.schemes.scheme import mirror_order


def photo(path: Path, seen: np.ndarray, orientation: int) -> Path:
    """A picture that is seen as ``seen`` (H, W, 3)."""
    encoded = cv2.imencode(".jpg", stored(seen, orientation), (cv2.IMWRITE_JPEG_QUALITY, 98))[1].tobytes()
    path.write_bytes(oriented(encoded, orientation))
    return path


@pytest.mark.parametrize("orientation", TURNS)
def test_points_move_with_their_pixels(orientation: int) -> None:
    pixels = np.arange(15).reshape(3, 5)
    points = np.argwhere(pixels >= 0)[:, ::-1]
    x, y = seen_points(points, (5, 3), orientation).T
    np.testing.assert_array_equal(TURNS[orientation](pixels)[y, x], pixels.ravel())


def test_fitted_faces_are_labels_whatever_exif_says(
    drawn_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    face, points = draw_face(np.random.default_rng(5))
    seen = np.pad(face, ((0, 20), (30, 0), (0, 0)), mode="edge")
    box = bounding_square(points + [30, 0])
    folder = tmp_path / "photos"
    folder.mkdir()
    photos = [photo(folder / f"{orientation}.jpg", seen, orientation) for orientation in TURNS]
    boxes = write_boxes(tmp_path / "boxes.csv", {path.name: box for path in photos})
    assert fit_folder(FolderRun(tmp_path / "fits", drawn_model, boxes=boxes), photos).faces == 8
    for path in photos:
        label = path.with_suffix(".pts")
        label.write_bytes((tmp_path / "fits" / "pts" / f"{path.stem}_1.pts").read_bytes())
        assert np.linalg.norm(read_pts(label) - points - [30, 0], axis=1).mean() < 2
    given = [str(drawn_model), "--boxes", str(boxes), "--normaliser", "box"]
    assert main(["evaluate", *given, "--data", f"pts:{folder}", "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())["datasets"][f"pts:{folder}"]
    assert report["fitted"] == 8
    assert report["nmed"]["median"] < 1e-4
    said = capsys.readouterr().err
    assert f"pts:{folder}: {folder / '2.jpg'} (orientation 2), {folder / '3.jpg'} (orientation 3)" in said
    assert f"say pts@stored:{folder}" in said


@pytest.mark.parametrize("orientation", TURNS)
def test_labels_of_stored_pixels_are_turned_with_their_pictures(orientation: int, tmp_path: Path) -> None:
    height, width = 50, 80
    points = np.random.default_rng(0).uniform(5, 45, (68, 2))
    photo(tmp_path / "a.jpg", TURNS[orientation](np.zeros((height, width, 3), np.uint8)), orientation)
    write_pts(tmp_path / "a.pts", points, base=0)
    (as_stored,) = read_dataset(f"pts0@stored+2:{tmp_path}").faces
    order = mirror_order(IBUG68) if orientation in (2, 4, 5, 7) else range(68)
    expected = seen_points(points + 2, (width, height), orientation)[list(order)]
    np.testing.assert_allclose(as_stored.landmarks, expected, atol=1e-3)
    plain = read_dataset(f"pts0+2:{tmp_path}")
    np.testing.assert_allclose(plain.faces[0].landmarks, points + 2, atol=1e-3)
    assert [f"pts0@stored+2:{tmp_path}" in problem for problem in plain.problems] == [True] * (orientation != 1)


def test_boxes_turn_and_poses_and_unknown_mirror_images_are_given_up(tmp_path: Path) -> None:
    write_pts(tmp_path / "a.pts", np.array([[1.0, 2.0], [5.0, 9.0], [7.0, 4.0]]))
    picture = photo(tmp_path / "a.jpg", np.zeros((80, 50, 3), np.uint8), 6)
    dataset = read_dataset(f"pts:{tmp_path}")
    face: FaceRecord = replace(dataset.faces[0], box=np.array([10.0, 20, 30, 15]), pose=np.zeros(3))
    (found,) = turned.as_seen(replace(dataset, faces=(face,))).faces
    np.testing.assert_array_equal(found.box, [49 - 35, 10, 15, 30])
    assert found.pose is None
    photo(picture, np.zeros((80, 50, 3), np.uint8), 5)
    mirrored = turned.as_seen(replace(dataset, faces=(face,), problems=()))
    assert mirrored.faces == ()
    assert "it is mirrored, and which landmarks of points3" in mirrored.problems[0]
