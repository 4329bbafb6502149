"""Faces are found in many pictures, in their order, and fitted; what has no face is accounted for."""

from pathlib import Path

import numpy as np
import pytest

import jaxfit
from jaxfit.data.detectors import Detection
from jaxfit.data.pictures import write_image


class Corners:
    """Finds as many faces as the first pixel says: squares along the upper edge, each ten pixels larger."""

    kinds = ("square",)
    rough = True

    def __call__(self, image: np.ndarray) -> list[Detection]:
        return [Detection(np.array([20.0 * k, 0, 30 + 10 * k, 30 + 10 * k]), "square") for k in range(image.flat[0])]


@pytest.fixture(scope="module")
def model() -> jaxfit.Model:
    return jaxfit.load("fast68")


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    cbook = pytest.importorskip("matplotlib.cbook")
    return jaxfit.read_image(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))


def drawn(faces: int) -> np.ndarray:
    picture = np.random.default_rng(faces).integers(0, 256, (90, 120), dtype=np.uint8)
    picture[0, 0] = faces
    return picture


def test_faces_come_in_the_order_of_the_pictures(tmp_path: Path) -> None:
    counts = [1, 0, 2, 3, 1, 0, 1, 2] * 3
    pictures: list[np.ndarray | Path] = [drawn(count) for count in counts]
    write_image(tmp_path / "two.png", drawn(2))
    pictures[2] = tmp_path / "two.png"
    found = jaxfit.find_faces(pictures, Corners())
    assert found.pictures.tolist() == [number for number, count in enumerate(counts) for _ in range(count)]
    assert sorted(found.problems) == [number for number, count in enumerate(counts) if count == 0]
    assert found.kinds == ("square",) * sum(counts)
    sides = [30 + 10 * k for count in counts for k in range(count)]
    assert found.boxes[:, 2].tolist() == sides


def test_what_is_found_is_fitted_as_if_the_boxes_were_given(model) -> None:
    counts = [2, 0, 1]
    pictures = [drawn(count) for count in counts]
    fits = jaxfit.fit(model, pictures, detector=Corners())
    assert fits.pictures.tolist() == [0, 0, 1, 2]
    assert fits.ok.tolist() == [True, True, False, True]
    assert list(fits.problems) == [2]
    assert "no face found" in fits.problems[2]
    found = jaxfit.find_faces(pictures, Corners())
    given = jaxfit.fit(model, [pictures[number] for number in found.pictures], found.boxes, passes=2)
    np.testing.assert_allclose(fits.landmarks[[0, 1, 3]], given.landmarks, atol=1e-2)
    np.testing.assert_array_equal(fits.boxes[[0, 1, 3]], given.boxes)


def test_pictures_that_cannot_be_used_do_not_stop_the_others(model, portrait, tmp_path: Path) -> None:
    torn = tmp_path / "torn.jpg"
    write_image(tmp_path / "whole.jpg", portrait)
    torn.write_bytes((tmp_path / "whole.jpg").read_bytes()[:2000])
    pictures = [tmp_path / "none.png", portrait, torn, tmp_path / "whole.jpg", portrait.astype(float), portrait[:0]]
    fits = jaxfit.fit(model, pictures)
    assert fits.ok.tolist() == [False, True, False, True, False, False]
    assert fits.kinds[1] == fits.kinds[3] == "haar-frontal"
    assert fits.problems[0].startswith(f"{tmp_path / 'none.png'}: ")
    assert "truncated" in fits.problems[2]
    assert "float64" in fits.problems[4]
    # A JPEG of the picture shows nearly the same; Haar's boxes jump.
    assert np.linalg.norm(fits.landmarks[1] - fits.landmarks[3], axis=1).mean() < 0.05 * fits.boxes[1, 2]


def test_no_pictures_have_no_faces(model) -> None:
    fits = jaxfit.fit(model, [])
    assert len(fits) == 0
    assert len(jaxfit.find_faces([]).boxes) == 0


def test_wrong_arguments_are_refused_before_anything_is_read(model) -> None:
    with pytest.raises(jaxfit.InputError, match="a detector among haar"):
        jaxfit.fit(model, ["none.jpg"], detector="hair")
    with pytest.raises(jaxfit.InputError, match="got both"):
        jaxfit.fit(model, ["none.jpg"], [[0, 0, 9, 9]], detector="haar")
    with pytest.raises(jaxfit.InputError, match="the detector says"):
        jaxfit.fit(model, ["none.jpg"], kind="square")
    with pytest.raises(jaxfit.InputError, match="put it in a list"):
        jaxfit.fit(model, "none.jpg")

    class Stranger(Corners):
        kinds = ("strange",)

    with pytest.raises(jaxfit.InputError, match="'strange'"):
        jaxfit.fit(model, ["none.jpg"], detector=Stranger())


def test_the_whole_picture_may_be_the_face(model, portrait) -> None:
    (face,) = jaxfit.detect_faces(portrait)
    x, y, side = (int(value) for value in face.box[:3])
    cut = portrait[y - side // 4 : y + side + side // 4, x - side // 4 : x + side + side // 4]
    whole = jaxfit.fit(model, [cut], detector="whole")
    found = jaxfit.fit(model, [portrait], [face.box], kind=face.kind)
    there = found.landmarks[0] - [x - side // 4, y - side // 4]
    eyes = np.linalg.norm(there[36] - there[45])
    assert np.linalg.norm(whole.landmarks[0] - there, axis=1).mean() < 0.08 * eyes


def test_dlib_finds_the_portrait(model, portrait) -> None:
    pytest.importorskip("dlib", reason='dlib is not installed: pip install "jaxfit[dlib]"')
    fits = jaxfit.fit(model, [portrait], detector="dlib")
    haar = jaxfit.fit(model, [portrait])
    assert fits.kinds == ("dlib",)
    eyes = np.linalg.norm(haar.landmarks[0, 36] - haar.landmarks[0, 45])
    assert np.linalg.norm(fits.landmarks[0] - haar.landmarks[0], axis=1).mean() < 0.08 * eyes


def test_yunet_needs_its_file(tmp_path: Path) -> None:
    with pytest.raises(jaxfit.InputError, match="there is no file"):
        jaxfit.find_faces([], f"yunet:{tmp_path / 'yunet.onnx'}")
    (tmp_path / "yunet.onnx").write_bytes(b"not a network")
    with pytest.raises(jaxfit.InputError, match="not a YuNet"):
        jaxfit.find_faces([], f"yunet:{tmp_path / 'yunet.onnx'}")
