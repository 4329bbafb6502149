"""Starting boxes and evaluation: who gets which box, and how faces without truth or fit are counted."""

from pathlib import Path

import numpy as np
import pytest

import jaxfit
from jaxfit.data.boxes import bounding_square
from jaxfit.data.images import write_image
from jaxfit.data.records import FaceRecord
from jaxfit.evaluating import match_boxes, start_boxes


def record(points: np.ndarray, image: Path = Path("a.png"), face: str = "a") -> FaceRecord:
    present = np.isfinite(points).all(1)
    return FaceRecord(image, points, present, present, None, None, face, face)


SQUARE = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])


def test_start_boxes_are_moved_and_scaled_as_documented() -> None:
    faces = [record(SQUARE * 10, face=str(number)) for number in range(3000)]
    boxes = start_boxes(faces)
    centres = boxes[:, :2] + boxes[:, 2:] / 2
    np.testing.assert_allclose(centres.mean(0), 50, atol=0.5)
    np.testing.assert_allclose(centres.std(0), 6, rtol=0.05)
    assert np.log(boxes[:, 2] / 100).std() == pytest.approx(0.08, rel=0.05)
    np.testing.assert_array_equal(boxes[:, 2], boxes[:, 3])


def test_a_face_gets_the_same_start_in_any_company() -> None:
    faces = [record(SQUARE, face=str(number)) for number in range(5)]
    np.testing.assert_array_equal(start_boxes(faces)[3], start_boxes(faces[3:4])[0])
    assert not np.array_equal(start_boxes(faces, seed=1), start_boxes(faces))
    with pytest.raises(jaxfit.InputError, match="seed of 0 or more"):
        start_boxes(faces, seed=-1)


def test_each_box_goes_to_one_face() -> None:
    left, right = record(SQUARE), record(SQUARE + [50, 0])
    box_left, box_right = bounding_square(SQUARE), bounding_square(SQUARE + [48, 0])
    both = match_boxes([left, right], {"a.png": [box_right, box_left]})
    np.testing.assert_array_equal(both, [box_left, box_right])
    one = match_boxes([left, right], {"a.png": [box_right]})
    assert np.isnan(one[0]).all()
    np.testing.assert_array_equal(one[1], box_right)
    assert np.isnan(match_boxes([left], {"b.png": [box_left]})).all()


def test_faces_without_truth_or_fit_are_counted(tmp_path: Path) -> None:
    model = jaxfit.load("sdm68")
    picture = np.random.default_rng(0).integers(0, 255, (120, 120), np.uint8)
    write_image(tmp_path / "a.png", picture)
    points = np.random.default_rng(1).uniform(30, 90, (68, 2))
    hidden, cornerless = points.copy(), points.copy()
    hidden[5] = np.nan
    cornerless[36] = np.nan
    present = tmp_path / "a.png"
    faces = [
        record(points, present, "whole"),
        record(hidden, present, "hidden"),
        record(cornerless, present, "cornerless"),
        record(points, tmp_path / "missing.png", "missing"),
    ]
    result = jaxfit.evaluate(model, faces, start_boxes(faces))
    assert np.isfinite(result.errors[:2]).all()
    assert np.isnan(result.errors[2])
    assert result.errors[3] == np.inf
    assert set(result.problems) == {3}
    assert result.seconds_per_face > 0


def test_faces_of_other_landmarks_are_refused() -> None:
    with pytest.raises(jaxfit.InputError, match="finds 68 landmarks"):
        jaxfit.evaluate(jaxfit.load("sdm68"), [record(SQUARE)], np.zeros((1, 4)))
