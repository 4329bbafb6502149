"""Crops show the image function at the mapped coordinates, and the map goes both ways."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfit.data.boxes import box_centre, box_problem
from jaxfit.data.crops import Crops, cut, cut_face, to_crop, to_image
from jaxfit.errors import InputError
from jaxfit.image.frame import Frame

FRAME = Frame(crop=64, face=36.0)


def crop_points(frame=FRAME):
    """(crop, crop, 2): the coordinates of each crop pixel."""
    y, x = np.mgrid[: frame.crop, : frame.crop]
    return np.stack([x, y], 2).astype(float)


def waves(points, period):
    return 127.5 + 110 * np.sin(points[..., 0] * 6.283 / period + 1) * np.cos(points[..., 1] * 5.1 / period)


def picture(height, width, function):
    y, x = np.mgrid[:height, :width]
    return np.round(function(np.stack([x, y], 2).astype(float))).astype(np.uint8)


@pytest.mark.parametrize("shrink", [0.13, 0.37, 0.9, 1.0, 1.05, 1.3, 1.9, 2.0, 2.6, 3.0])
@pytest.mark.parametrize("centre", [(0.5, 0.5), (0.0, 0.3), (1.02, 0.98), (-3.0, 0.5), (0.5, 4.0)])
def test_crops_show_the_image_function(shrink, centre):
    """Also for faces partly or wholly outside: beyond the edge the edge goes on."""
    period = 50 * max(shrink, 1)  # smooth in the image and in the crop
    height, width = (220, 300) if shrink < 2 else (500, 600)
    image = picture(height, width, lambda points: waves(points, period))
    centre = np.array(centre) * [width, height] + [0.37, 0.21]
    crop = cut_face(image, centre, shrink * FRAME.face, FRAME)
    points = np.clip(to_image(crop_points(), crop.scale, crop.offset), 0, [width - 1, height - 1])
    error = np.abs(crop.pixels - waves(points, period))
    # Of 255 grey levels, rounding the image, the samples and their mean costs one; interpolation a fraction; and where
    # blocks of pixels become one, the image's edge comes from half a block inside.
    assert error.max() < (2 if shrink < 2 else 3)
    assert error.mean() < 0.5


@pytest.mark.parametrize("shrink", [0.5, 1.0, 1.4, 2.3, 3.7, 11.0])
def test_crops_are_not_shifted(shrink):
    """The centre of mass of a blob is where the map says, to a fraction of a hundredth of the blob."""
    true = np.array([403.3, 398.8])
    sigma = 5 * shrink
    image = picture(800, 800, lambda points: 250 * np.exp(-((points - true) ** 2).sum(2) / (2 * sigma**2)))
    crop = cut_face(image, true + 3.21 * shrink, shrink * FRAME.face, FRAME)
    weights = crop.pixels / crop.pixels.sum()
    measured = (weights[..., None] * crop_points()).sum((0, 1))
    np.testing.assert_allclose(measured, to_crop(true, crop.scale, crop.offset), atol=0.03)


@pytest.mark.parametrize("shrink", [0.5, 2.3])
def test_labels_that_are_off_are_so_in_crops(shrink):
    """As labels have it, a blob's middle lies two picture pixels right of and below where it is."""
    middle = np.array([203.3, 198.8])
    image = picture(400, 400, lambda points: 250 * np.exp(-((points - middle) ** 2).sum(2) / (2 * (5 * shrink) ** 2)))
    crop = cut_face(image, middle + 2, shrink * FRAME.face, Frame(crop=64, face=36.0, shift=2.0))
    weights = crop.pixels / crop.pixels.sum()
    measured = (weights[..., None] * crop_points()).sum((0, 1))
    np.testing.assert_allclose(measured, to_crop(middle + 2, crop.scale, crop.offset), atol=0.03)
    np.testing.assert_allclose(measured, FRAME.middle, atol=0.03)


def test_a_linear_ramp_stays_linear():
    image = picture(200, 250, lambda points: points[..., 0])
    crop = cut_face(image, np.array([120.25, 100.5]), 1.7 * FRAME.face, FRAME)
    expected = to_image(crop_points(), crop.scale, crop.offset)[..., 0]
    np.testing.assert_allclose(crop.pixels, expected, atol=1.01)  # rounded twice


def test_at_the_crops_own_scale_and_grid_the_pixels_are_the_images():
    image = np.random.default_rng(0).integers(0, 256, (90, 100), np.uint8)
    crop = cut_face(image, np.array([50.5, 40.5]), FRAME.face, FRAME)
    assert crop.scale == 1
    left, top = crop.offset.astype(int)
    np.testing.assert_array_equal(crop.pixels, image[top : top + 64, left : left + 64])


@pytest.mark.parametrize("shrink", [2.5, 5.0, 7.3])
def test_shrinking_does_not_alias(shrink):
    """White noise loses its contrast with the root of the number of pixels that become one."""
    image = np.random.default_rng(0).integers(0, 256, (600, 600), np.uint8)
    crop = cut_face(image, np.array([300.0, 300.0]), shrink * FRAME.face, FRAME)
    assert crop.pixels.std() < 1.1 * image.std() / shrink
    assert abs(crop.pixels.mean() - image.mean()) < 1


def test_the_face_lies_in_the_middle_at_its_size():
    centre, side = np.array([33.3, 70.7]), 123.4
    crop = cut_face(np.zeros((100, 100), np.uint8), centre, side, FRAME)
    np.testing.assert_allclose(to_crop(centre, crop.scale, crop.offset), 31.5)
    corners = to_crop(np.array([centre - side / 2, centre + side / 2]), crop.scale, crop.offset)
    np.testing.assert_allclose(corners[1] - corners[0], FRAME.face)


def test_only_the_part_around_the_face_matters():
    image = np.zeros((100, 40_000), np.uint8)  # wider than OpenCV warps
    image[:, 35_000:35_200] = 200
    crop = cut_face(image, np.array([35_100.0, 50.0]), FRAME.face, FRAME)
    assert (crop.pixels == 200).all()


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("length", [32_000, 32_001, 32_767, 70_000])
def test_faces_larger_than_opencv_warps(length, flip):
    """A long ramp arrives where the map says, as one of a handier size does."""
    ramp = np.linspace(0, 255, length)
    image = np.repeat(np.round(ramp).astype(np.uint8)[None], 3, 0)
    centre = np.array([length / 2, 1.0])
    crop = cut_face(image.T if flip else image, centre[::-1] if flip else centre, 0.8 * length, FRAME)
    expected = np.interp(to_image(crop_points(), crop.scale, crop.offset)[..., int(flip)], np.arange(length), ramp)
    np.testing.assert_allclose(crop.pixels, expected, atol=1.01 + 255 / 64 / 4)


@given(
    st.tuples(*[st.floats(-2e6, 2e6) | st.floats(allow_nan=False)] * 2, *[st.floats(1e-3, 1e6) | st.floats()] * 2),
    st.sampled_from([(20, 30), (1, 40_000), (40_000, 2)]),
)
def test_no_box_without_a_problem_is_refused(box, shape):
    box = np.array(box)
    if box_problem(box, shape) is None:
        crop = cut_face(np.full(shape, 77, np.uint8), box_centre(box), float(box[2:].mean()), FRAME)
        assert (crop.pixels == 77).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1)])
def test_tiny_pictures(shape):
    crop = cut_face(np.full(shape, 77, np.uint8), np.array([0.0, 0.0]), 500.0, FRAME)
    assert (crop.pixels == 77).all()


@pytest.mark.parametrize(
    ("centre", "side"), [((np.nan, 0), 9.0), ((0, np.inf), 9.0), ((0, 0), 0.0), ((0, 0), -1.0), ((0, 0), np.nan)]
)
def test_impossible_faces_are_refused(centre, side):
    with pytest.raises(InputError, match="finite centre and rotation and a positive"):
        cut_face(np.zeros((9, 9), np.uint8), np.array(centre, float), side, FRAME)


@given(st.floats(0.01, 1e3), st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
def test_the_maps_are_inverse(scale, x, y):
    points = np.random.default_rng(0).uniform(-100, 100, (3, 4, 2))
    there = to_image(points, scale, np.array([x, y]))
    np.testing.assert_allclose(to_crop(there, scale, np.array([x, y])), points, atol=1e-6)


def test_a_batch_holds_what_single_crops_are():
    rng = np.random.default_rng(0)
    crops = Crops.empty(3, FRAME)
    for row in (0, 2):
        image = rng.integers(0, 256, (80 + row, 90), np.uint8)
        centre, side = rng.uniform(20, 60, 2), float(rng.uniform(20, 100))
        cut(image, centre, side, crops, row)
        single = cut_face(image, centre, side, FRAME)
        np.testing.assert_array_equal(crops.pixels[row], single.pixels)
        points = rng.uniform(0, 64, (5, 2))
        np.testing.assert_allclose(
            crops.to_images(points[None], np.array([row]))[0], to_image(points, single.scale, single.offset)
        )
    assert len(crops) == 3
    assert not crops.pixels[1].any()
    rows = np.array([2, 0, 2, 1])
    points = rng.uniform(0, 64, (4, 5, 2))
    np.testing.assert_allclose(crops.from_images(crops.to_images(points, rows), rows), points)


def test_crops_that_were_cut_make_a_batch_with_black_ones_where_there_are_reasons():
    rng = np.random.default_rng(0)
    one, other = (
        cut_face(rng.integers(0, 256, (80, 90), np.uint8), rng.uniform(20, 60, 2), float(rng.uniform(20, 100)), FRAME)
        for _ in range(2)
    )
    crops = Crops.of([one, "there is no face box", other], FRAME)
    for row, crop in ((0, one), (2, other)):
        np.testing.assert_array_equal(crops.pixels[row], crop.pixels, strict=True)
        assert crops.scale[row] == crop.scale
        np.testing.assert_array_equal(crops.offset[row], crop.offset)
    assert not crops.pixels[1].any()
    np.testing.assert_array_equal(crops.to_images(np.ones((1, 3, 2)), np.array([1])), 1)
    assert len(Crops.of([], FRAME)) == 0


@pytest.mark.parametrize("degrees", [-70, 15, 90, 180])
def test_a_turned_crop_is_one_of_a_turned_picture(degrees):
    """And its points go to where they are in the picture."""
    smooth = cv2.GaussianBlur(np.random.default_rng(0).normal(128, 300, (240, 240)), (0, 0), 6)
    picture = np.clip(smooth, 0, 255).astype(np.uint8)
    centre, rotation = np.array([118.0, 121.0]), np.radians(degrees)
    frame = Frame(48, 30.0, 0.0)
    there = cv2.getRotationMatrix2D(tuple(centre.tolist()), degrees, 1)  # turns the picture back
    upright = cut_face(cv2.warpAffine(picture, there, (240, 240)), centre, 60.0, frame)
    turned = cut_face(picture, centre, 60.0, frame, rotation)
    assert np.abs(turned.pixels.astype(int) - upright.pixels).mean() < 2
    points = np.random.default_rng(1).uniform(0, 48, (5, 2))
    in_picture = to_image(points, turned.scale, turned.offset, turned.rotation)
    in_upright = to_image(points, upright.scale, upright.offset)
    np.testing.assert_allclose(in_picture @ there[:, :2].T + there[:, 2], in_upright, atol=1e-9)
    np.testing.assert_allclose(to_crop(in_picture, turned.scale, turned.offset, turned.rotation), points, atol=1e-9)


def test_a_crop_that_is_not_turned_is_the_same_to_the_bit():
    picture = np.random.default_rng(0).integers(0, 256, (90, 90), np.uint8)
    for side in (20.0, 55.0, 200.0):
        one, other = (cut_face(picture, np.array([40.0, 50.0]), side, FRAME, *turn) for turn in ((), (0.0,)))
        np.testing.assert_array_equal(one.pixels, other.pixels)


@pytest.mark.parametrize("side", [30.0, 3e4, 3e6, 3e8])
def test_panoramas_are_cut_however_small_they_are_in_the_crop(side):
    grey = np.full((20, 40_000), 7, np.uint8)
    assert (cut_face(grey, np.array([39_000.0, 10.0]), side, Frame(crop=64, face=32.0), 0.5).pixels == 7).all()
