"""Detections: the geometry on drawn inputs, the finding on real pictures."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.detectors import Detection, Search, best_match, detect_faces, detector_named
from jaxfit.data.detectors.detector import AnyRotation, merged, turned_back
from jaxfit.data.pictures import read_image, to_grey
from jaxfit.errors import ImageError, InputError

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


@pytest.mark.parametrize("name", ["yunet", "haar"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (500, 1), (30, 40), (300, 1000)])
def test_empty_pictures_have_no_faces(shape, name):
    assert detect_faces(np.full(shape, 128, np.uint8), name) == []


@pytest.mark.parametrize(
    ("name", "any_rotation"), [("yunet", False), ("yunet", True), ("haar", False), ("haar", True), ("whole", False)]
)
def test_detectors_take_what_fit_takes_and_refuse_the_rest(name, any_rotation):
    detector = detector_named(name, Search(any_rotation=any_rotation))
    picture = np.full((60, 80, 3), 90, np.uint8)
    seen = detector(picture)
    for same in (
        picture.astype(np.uint16) * 257,
        picture[::-1],
        picture[..., :1],
        np.dstack([picture, picture[..., 0]]),
    ):
        assert [tuple(face.box) for face in detector(same)] == [tuple(face.box) for face in seen]
    for wrong in (picture / 255, None, "a.jpg"):
        for look in (detector, lambda image: detect_faces(image, detector)):
            with pytest.raises(ImageError, match="expected"):
                look(wrong)


@pytest.mark.parametrize("bad", [{"smallest": 3.0}, {"smallest": np.nan}, {"score": 1.5}, {"score": 0.0}], ids=str)
def test_searches_that_make_no_sense_are_refused(bad):
    with pytest.raises(InputError, match=r"(smallest|score): expected a"):
        Search(**bad)


@pytest.mark.parametrize(
    ("name", "search"),
    [
        ("haar", {"score": 0.5}),
        ("dlib", {"score": 0.5}),
        ("whole", {"any_rotation": True}),
        ("whole", {"smallest": 9.0}),
    ],
    ids=str,
)
def test_what_a_detector_does_not_use_is_refused(name, search):
    with pytest.raises(InputError, match=f"the detector {name} does not use {next(iter(search)).replace('_', ' ')}"):
        detector_named(name, Search(**search))


@pytest.mark.parametrize("wrong", ["", "nose", "haar:file.xml"])
def test_what_is_no_detector_is_refused(wrong):
    with pytest.raises(InputError, match=r"expected a detector.*yunet:FILE"):
        detector_named(wrong)


def test_the_smallest_face_grows_with_the_picture_unless_it_is_given():
    assert Search().smallest_in((300, 400)) == 24
    assert Search().smallest_in((3000, 4000, 3)) == pytest.approx(np.sqrt(12e6) / 60)
    assert Search(smallest=10.0).smallest_in((3000, 4000)) == 10


def test_of_several_finds_of_a_face_the_best_is_kept():
    finds = [Detection(TRUTH + shift, "yunet", score=score) for shift, score in ((0, 0.7), (3, 0.9), (100, 0.8))]
    assert sorted((face.score, face.box[0]) for face in merged(finds)) == [(0.8, 200), (0.9, 103)]


@dataclass(frozen=True)
class Bright:
    """Finds the brightest spot, as a face that is turned as the spot is around the middle of its bright field."""

    kinds = ("square",)
    colour = False
    rough = False

    def __call__(self, image):
        y, x = np.unravel_index(np.argmax(image), image.shape)
        ys, xs = np.nonzero(image > 100)
        rotation = np.degrees(np.arctan2(y - ys.mean(), x - xs.mean())) + 90  # a spot on top is upright
        return [Detection(np.array([x - 2.5, y - 1.5, 6.0, 4.0]), "square", rotation)]


def test_a_picture_turned_by_quarters_tells_where_the_face_is_in_it():
    picture = np.zeros((40, 60), np.uint8)
    picture[10:20, 30:41] = 150
    picture[10, 35] = 250
    centres = []
    for quarters in range(4):
        turned = np.ascontiguousarray(np.rot90(picture, quarters))
        (plain,) = Bright()(turned)
        back = turned_back(plain, quarters, picture.shape)
        centres.append(box_centre(back.box) - (0.5, 0.5))
        assert back.rotation == pytest.approx(0, abs=3)
    # Boxes hold pixels from edge to edge, so that the middle of one pixel stays the middle of one.
    np.testing.assert_allclose(np.round(centres), np.round(centres[0])[None].repeat(4, 0), atol=1)
    assert len(AnyRotation(Bright())(picture)) == 1


@pytest.fixture(scope="module")
def portraits(real_dataset):
    """Grey pictures and the bounding squares of their faces."""
    faces = real_dataset("pts:lfpw68").faces[::27]
    return [(to_grey(read_image(face.image)), bounding_square(face.landmarks)) for face in faces]


@pytest.mark.parametrize("name", ["yunet", "haar"])
def test_most_portraits_are_found(portraits, name):
    results = [(detect_faces(grey, name), square) for grey, square in portraits]
    hits = [best_match(detections, square) for detections, square in results]
    assert np.mean([hit is not None for hit in hits]) > 0.9
    assert np.mean([len(detections) for detections, _ in results]) < 1.4
    for detections, _ in results:
        areas = [detection.box[2] * detection.box[3] for detection in detections]
        assert areas == sorted(areas, reverse=True)


@pytest.mark.parametrize("name", ["yunet", "haar"])
def test_boxes_grow_and_move_with_the_picture(portraits, name):
    """A picture twice as large, or in the corner of a larger one, shows the same face."""
    for grey, square in portraits[:4]:
        plain = best_match(detect_faces(grey, name), square)
        double = best_match(detect_faces(cv2.resize(grey, None, fx=2, fy=2), name), 2 * square)
        padded = np.pad(grey, ((30, 0), (50, 0)), "edge")
        placed = best_match(detect_faces(padded, name), square + np.array([50, 30, 0, 0]))
        tolerance = 0.12 * square[2]
        np.testing.assert_allclose(double.box / 2, plain.box, atol=2 * tolerance)
        np.testing.assert_allclose(box_centre(placed.box) - [50, 30], box_centre(plain.box), atol=tolerance)


def test_small_faces_are_found_in_the_parts_of_a_large_picture(portraits):
    """Also where parts meet, and none twice."""
    width, places = 40, [(x, y) for y in (5, 500, 870) for x in (20, 1230, 1290, 2400)]
    canvas = np.full((1000, 2600), 120, np.uint8)
    for (grey, square), (x, y) in zip(portraits, places, strict=False):
        scale = width / square[2]
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        height, across = min(small.shape[0], 1000 - y), min(small.shape[1], 2600 - x)
        canvas[y : y + height, x : x + across] = small[:height, :across]
    squares = [
        np.array([*(square[:2] * width / square[2] + place), width, width])
        for (_, square), place in zip(portraits, places, strict=False)
    ]
    found = detect_faces(canvas, "yunet", Search(smallest=30.0))
    assert sum(best_match(found, square) is not None for square in squares) >= len(places) - 1
    assert len(found) <= len(places) + 1


@pytest.mark.parametrize(
    ("degrees", "width", "search"),
    [
        (-45, 120, Search()),
        (25, 40, Search()),
        (45, 48, Search()),
        (-90, 120, Search()),
        (135, 120, Search(any_rotation=True)),
        (180, 40, Search(any_rotation=True)),
    ],
    ids=str,
)
def test_faces_say_how_they_are_turned(portraits, degrees, width, search):
    """Also where the network is not sure of them as they stand in the picture; and nothing else is found."""
    errors, others = [], 0
    for grey, square in portraits[:8]:
        small = cv2.resize(grey, None, fx=width / square[2], fy=width / square[2], interpolation=cv2.INTER_AREA)
        small = np.pad(small, width, "edge")  # so that nothing of the face leaves the picture
        square = square * width / square[2] + [width, width, 0, 0]
        there = cv2.getRotationMatrix2D(tuple(box_centre(square).tolist()), -degrees, 1)
        turned = cv2.warpAffine(small, there, small.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
        plain, found = detect_faces(small), detect_faces(turned, search=search)
        before, after = best_match(plain, square), best_match(found, square)
        errors.append(180.0 if after is None else abs((after.rotation - before.rotation - degrees + 180) % 360 - 180))
        others += len(found) - len(plain)
    assert np.median(errors) < 8
    assert np.sort(errors)[-2] < 25
    assert others <= 1


@pytest.mark.parametrize("brightness", [0.25, 0.08, 0.04])
def test_faces_are_found_in_dark_pictures(portraits, brightness):
    found = [detect_faces(np.round(brightness * grey).astype(np.uint8)) for grey, _ in portraits[:8]]
    hits = [best_match(faces, square) is not None for faces, (_, square) in zip(found, portraits, strict=False)]
    assert sum(hits) >= 7


def test_profiles_are_found_on_both_sides(real_dataset):
    faces = [face for face in real_dataset("aflw:aflw").faces if 60 < abs(face.pose[2]) < 90][:60:2]
    found = {"left": 0, "right": 0}
    for face in faces:
        grey = to_grey(read_image(face.image))
        match = best_match(detect_faces(grey, "haar"), bounding_square(face.landmarks))
        found["left" if face.pose[2] > 0 else "right"] += match is not None and match.kind == "haar-profile"
    assert min(found.values()) >= 3
