"""Faces are found in many pictures, in their order, and fitted; what has no face is accounted for."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from small import Corners, random_model, with_corners

import jaxfit
from jaxfit.data.pictures import Image, write_image
from jaxfit.fitting.find import find_faces
from jaxfit.models.model import Model


@pytest.fixture(scope="module")
def model() -> Model:
    return jaxfit.load("fast68")


def test_faces_come_in_the_order_of_the_pictures(tmp_path: Path) -> None:
    counts = [1, 0, 2, 3, 1, 0, 1, 2] * 3
    pictures: list[np.ndarray | Path] = [with_corners(count) for count in counts]
    write_image(tmp_path / "two.png", with_corners(2))
    pictures[2] = tmp_path / "two.png"
    found = find_faces(pictures, Corners())
    assert found.pictures.tolist() == [number for number, count in enumerate(counts) for _ in range(count)]
    assert [problem.picture for problem in found.problems] == [n for n, count in enumerate(counts) if count == 0]
    assert found.kinds == ("square",) * sum(counts)
    sides = [30 + 10 * k for count in counts for k in range(count)]
    assert found.boxes[:, 2].tolist() == sides


def test_what_is_found_is_fitted_as_if_the_boxes_were_given() -> None:
    model, pictures = random_model("sdm"), [with_corners(count) for count in (2, 0, 1)]
    fits = jaxfit.fit(model, pictures, detector=Corners())
    assert fits.pictures.tolist() == [0, 0, 2]
    assert fits.ok.all()
    assert [(problem.picture, problem.row) for problem in fits.problems] == [(1, None)]
    assert "no face found" in fits.problems[0].why
    found = find_faces(pictures, Corners())
    assert found.problems == fits.problems
    given = jaxfit.fit(model, [pictures[number] for number in found.pictures], found.boxes, passes=2)
    np.testing.assert_array_equal(fits.landmarks, given.landmarks)
    np.testing.assert_array_equal(fits.boxes, given.boxes)


def test_pictures_that_cannot_be_used_do_not_stop_the_others(
    model: Model, portrait: np.ndarray, tmp_path: Path
) -> None:
    torn = tmp_path / "torn.jpg"
    write_image(tmp_path / "whole.jpg", portrait)
    torn.write_bytes((tmp_path / "whole.jpg").read_bytes()[:2000])
    pictures: list[Image] = [
        tmp_path / "none.png",
        portrait,
        torn,
        tmp_path / "whole.jpg",
        portrait.astype(float),
        portrait[:0],
    ]
    fits = jaxfit.fit(model, pictures)
    assert fits.pictures.tolist() == [1, 3]
    assert fits.ok.all()
    assert fits.kinds == ("yunet",) * 2
    assert [problem.picture for problem in fits.problems] == [0, 2, 4, 5]
    assert str(fits.problems[0]).startswith(f"{tmp_path / 'none.png'}: cannot be read")
    assert "truncated" in fits.problems[1].why
    assert "float64" in fits.problems[2].why
    assert find_faces(pictures).problems == fits.problems
    # A JPEG of the picture shows nearly the same.
    assert np.linalg.norm(fits.landmarks[0] - fits.landmarks[1], axis=1).mean() < 0.05 * fits.boxes[0, 2]


def test_no_pictures_have_no_faces(model: Model) -> None:
    assert len(jaxfit.fit(model, [])) == 0
    found = find_faces([])
    assert (found.pictures.shape, found.boxes.shape, found.kinds, found.problems) == ((0,), (0, 4), (), ())


def test_wrong_arguments_are_refused_before_anything_is_read(model: Model) -> None:
    with pytest.raises(jaxfit.InputError, match="a detector among"):
        jaxfit.fit(model, ["none.jpg"], detector="hair")
    with pytest.raises(jaxfit.InputError, match="got both"):
        jaxfit.fit(model, ["none.jpg"], [[0, 0, 9, 9]], detector="haar")
    with pytest.raises(jaxfit.InputError, match=r"how faces are looked for .*; got both"):
        jaxfit.fit(model, ["none.jpg"], [[0, 0, 9, 9]], search=jaxfit.Search(any_rotation=True))
    with pytest.raises(jaxfit.InputError, match="the detector says"):
        jaxfit.fit(model, ["none.jpg"], kind="haar-frontal")
    with pytest.raises(jaxfit.InputError, match="put it in a list"):
        jaxfit.fit(model, "none.jpg")
    with pytest.raises(jaxfit.InputError, match="put it in a list"):
        find_faces("none.jpg")
    with pytest.raises(jaxfit.InputError, match="'strange'"):
        jaxfit.fit(model, ["none.jpg"], detector=Corners(kinds=("strange",)))


def test_the_whole_picture_may_be_the_face(model: Model, portrait: np.ndarray) -> None:
    (face,) = jaxfit.detect_faces(portrait)
    x, y, side = (int(value) for value in face.box[:3])
    cut = portrait[y - side // 4 : y + side + side // 4, x - side // 4 : x + side + side // 4]
    whole = jaxfit.fit(model, [cut], detector="whole")
    found = jaxfit.fit(model, [portrait], [face.box], kind=face.kind, rotations=[face.rotation])
    there = found.landmarks[0] - [x - side // 4, y - side // 4]
    eyes = np.linalg.norm(there[36] - there[45])
    assert np.linalg.norm(whole.landmarks[0] - there, axis=1).mean() < 0.08 * eyes


def test_dlib_finds_the_portrait(model: Model, portrait: np.ndarray) -> None:
    pytest.importorskip("dlib", reason='dlib is not installed: pip install "jaxfit[dlib]"')
    fits = jaxfit.fit(model, [portrait], detector="dlib")
    haar = jaxfit.fit(model, [portrait], detector="haar")
    assert fits.kinds == ("dlib",)
    eyes = np.linalg.norm(haar.landmarks[0, 36] - haar.landmarks[0, 45])
    assert np.linalg.norm(fits.landmarks[0] - haar.landmarks[0], axis=1).mean() < 0.08 * eyes


def test_a_yunet_of_ones_own_is_a_file_that_opencv_can_run(tmp_path: Path) -> None:
    with pytest.raises(jaxfit.InputError, match="there is no file"):
        find_faces([], f"yunet:{tmp_path / 'yunet.onnx'}")
    (tmp_path / "yunet.onnx").write_bytes(b"not a network")
    with pytest.raises(jaxfit.InputError, match="not a YuNet"):
        find_faces([], f"yunet:{tmp_path / 'yunet.onnx'}")


@pytest.mark.parametrize("degrees", [30, -30, 90, 180])
def test_turned_faces_are_fitted_as_upright_ones(model: Model, portrait: np.ndarray, degrees: float) -> None:
    """Crops are cut turned: the landmarks turn with the picture."""
    height, width = portrait.shape[:2]
    there = cv2.getRotationMatrix2D((width / 2, height / 2), -degrees, 1)
    turned = cv2.warpAffine(portrait, there, (width, height), borderMode=cv2.BORDER_REPLICATE)
    plain = jaxfit.fit(model, [portrait])
    search = jaxfit.Search(any_rotation=abs(degrees) >= 90)
    found = jaxfit.fit(model, [turned], search=search)
    assert len(found) == 1
    assert abs((found.rotations[0] - plain.rotations[0] - degrees + 180) % 360 - 180) < 10
    expected = plain.landmarks[0] @ there[:, :2].T + there[:, 2]
    eyes = np.linalg.norm(expected[36] - expected[45])
    assert np.linalg.norm(found.landmarks[0] - expected, axis=1).mean() < 0.08 * eyes
    # Given boxes may say so, too.
    given = jaxfit.fit(model, [turned], found.boxes, kind=found.kinds, rotations=found.rotations)
    np.testing.assert_array_equal(given.landmarks, found.landmarks)
