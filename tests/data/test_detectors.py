"""Detections: the geometry on drawn inputs, the finding on real pictures."""

import cv2
import numpy as np
import pytest

from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.detectors import Detection, best_match, detect_faces
from jaxfit.data.pictures import read_image, to_grey

TRUTH = np.array([100.0, 100.0, 50.0, 50.0])


def found(*box, kind="haar-frontal"):
    return Detection(np.array(box, float), kind)


@pytest.mark.parametrize(
    ("box", "matches"),
    [
        ((100, 100, 50, 50), True),
        ((75, 75, 100, 100), True),
        ((112, 112, 26, 26), True),
        ((60, 60, 130, 130), False),
        ((115, 115, 20, 20), False),
        ((130, 130, 50, 50), False),
        ((51, 100, 50, 50), False),
    ],
)
def test_a_match_lies_in_the_truth_and_has_its_size(box, matches):
    assert (best_match([found(*box)], TRUTH) is not None) == matches


def test_the_best_match_overlaps_most():
    near, exact = found(110, 110, 50, 50), found(101, 101, 50, 50, kind="haar-profile")
    assert best_match([near, exact, found(0, 0, 50, 50)], TRUTH) is exact
    assert best_match([], TRUTH) is None


@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (500, 1), (30, 40), (300, 1000)])
def test_empty_pictures_have_no_faces(shape):
    assert detect_faces(np.full(shape, 128, np.uint8)) == []


@pytest.fixture(scope="module")
def portraits(real_dataset):
    """Grey pictures and the bounding squares of their faces."""
    faces = real_dataset("pts:lfpw68").faces[::27]
    return [(to_grey(read_image(face.image, exif=False)), bounding_square(face.landmarks)) for face in faces]


def test_most_portraits_are_found(portraits):
    results = [(detect_faces(grey), square) for grey, square in portraits]
    hits = [best_match(detections, square) for detections, square in results]
    assert np.mean([hit is not None for hit in hits]) > 0.9
    assert np.mean([len(detections) for detections, _ in results]) < 1.4
    for detections, _ in results:
        areas = [detection.box[2] * detection.box[3] for detection in detections]
        assert areas == sorted(areas, reverse=True)


def test_boxes_grow_and_move_with_the_picture(portraits):
    """A picture twice as large, or in the corner of a larger one, shows the same face."""
    for grey, square in portraits[:4]:
        plain = best_match(detect_faces(grey), square)
        double = best_match(detect_faces(cv2.resize(grey, None, fx=2, fy=2)), 2 * square)
        placed = best_match(detect_faces(np.pad(grey, ((30, 0), (50, 0)), "edge")), square + np.array([50, 30, 0, 0]))
        tolerance = 0.12 * square[2]
        np.testing.assert_allclose(double.box / 2, plain.box, atol=2 * tolerance)
        np.testing.assert_allclose(box_centre(placed.box) - [50, 30], box_centre(plain.box), atol=tolerance)


def test_profiles_are_found_on_both_sides(real_dataset):
    faces = [face for face in real_dataset("aflw:aflw").faces if 60 < abs(face.pose[2]) < 90][:60:2]
    found = {"left": 0, "right": 0}
    for face in faces:
        grey = to_grey(read_image(face.image, exif=False))
        match = best_match(detect_faces(grey), bounding_square(face.landmarks))
        found["left" if face.pose[2] > 0 else "right"] += match is not None and match.kind == "haar-profile"
    assert min(found.values()) >= 3
