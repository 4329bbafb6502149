"""Heads before a camera: synthetic cameras are recovered, from any picture, and wrong requests are refused."""

# What may be None in the library is not here.
# mypy: disable-error-code="arg-type,union-attr,index,unused-ignore"

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxfit
from jaxfit.errors import InputError
from jaxfit.fitting.fits import Fits
from jaxfit.fitting.place import PUPIL_DISTANCE
from jaxfit.fitting.track import _Square, _Track
from jaxfit.schemes.known import IBUG68

COUNT = 9  # a batch of eight, and one of one
CAMERA = jaxfit.PinholeCamera(900.0, 950.0, 640.0, 350.0)


@pytest.fixture(scope="module")
def model() -> jaxfit.Model:
    return jaxfit.with_heads(jaxfit.load("face68"))


def seen(model: jaxfit.Model, camera: jaxfit.PinholeCamera) -> tuple[Fits, np.ndarray, Rotation]:
    """Fits of mean heads, whose pupils are 63 mm apart, as OpenCV projects them; where and how they are."""
    rng = np.random.default_rng(0)
    assert model.space_3d is not None
    mean = np.asarray(model.space_3d.model.mean, np.float64)
    pupils = [mean[list(eye)].mean(0) for eye in IBUG68.pupils or ()]
    mean = mean * PUPIL_DISTANCE / np.linalg.norm(pupils[1] - pupils[0])
    turns = Rotation.from_euler("YXZ", rng.uniform([-50, -20, -30], [50, 20, 30], (COUNT, 3)), degrees=True)
    places = rng.uniform([-150, -120, 350], [150, 120, 1200], (COUNT, 3))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points = np.stack(
        [
            cv2.projectPoints(mean, turn.as_rotvec(), place, matrix, None)[0][:, 0]
            for turn, place in zip(turns, places, strict=True)
        ]
    )
    nobody = jaxfit.fit(model, [], [])
    fits = replace(
        nobody,
        names=("a.jpg",),
        sizes=np.array([[1280, 720]]),
        pictures=np.zeros(COUNT, int),
        boxes=np.ones((COUNT, 4)),
        kinds=("square",) * COUNT,
        rotations=np.zeros(COUNT),
        landmarks=points,
        **{name: np.zeros((COUNT, *values.shape[1:])) for name, values in nobody.arrays.items() if name in FILLED},
        confidence=np.ones(COUNT),
    )
    return fits, places, turns


FILLED = ("landmarks_3d", "pose", "scale", "b", "covariances", "visible")


def test_synthetic_cameras_are_recovered(model: jaxfit.Model) -> None:
    fits, places, turns = seen(model, CAMERA)
    lost = fits.landmarks.copy()
    lost[2] = np.nan
    found = jaxfit.place_heads(model, replace(fits, landmarks=lost), jaxfit.Placing(CAMERA))
    assert found.position is not None
    assert found.rotation_vector is not None
    known = np.arange(COUNT) != 2
    assert np.isnan(found.position[2]).all()
    assert np.isnan(found.rotation_vector[2]).all()
    np.testing.assert_allclose(found.position[known], places[known], rtol=2e-3, atol=0.5)
    apart = (Rotation.from_rotvec(found.rotation_vector[known]).inv() * turns[known]).magnitude()
    assert np.degrees(apart).max() < 0.2
    # A larger head is farther away, in the same direction.
    larger = jaxfit.place_heads(model, fits, jaxfit.Placing(CAMERA, 2 * PUPIL_DISTANCE)).position
    np.testing.assert_allclose(larger[known], 2 * found.position[known], rtol=1e-6)
    held = jaxfit.place_heads(model, fits, jaxfit.Placing(CAMERA), np.zeros(model.space_3d.modes))
    np.testing.assert_allclose(held.position, places, rtol=2e-3, atol=0.5)
    row = next(iter(found.rows()))
    assert row["position"] == np.round(found.position[0], 3).tolist()
    flat = found.to_dicts()[0]
    assert tuple(flat) == found.columns
    assert [flat[f"head_rotation_{axis}"] for axis in "xyz"] == row["rotation_vector"]


def test_through_a_film_the_shape_of_a_person_is_held(model: jaxfit.Model) -> None:
    fits, places, _ = seen(model, CAMERA)
    tracker = jaxfit.fitting.Tracker(model, "whole", placing=jaxfit.Placing(CAMERA))
    person = _Track(1, 0, _Square(np.zeros(4), 0.0, 0.0))
    shapes, held, alone = [], [], []
    for frame in range(40):
        noise = np.random.default_rng(frame).normal(0, 1.5, fits.landmarks[:1].shape)
        noisy = replace(fits[:1], landmarks=fits.landmarks[:1] + noise)
        held.append(tracker._placed(person, noisy).position)
        alone.append(jaxfit.place_heads(model, noisy, jaxfit.Placing(CAMERA)).position)
        shapes.append(person.shape)
    assert all(shape is shapes[29] for shape in shapes[29:])
    assert shapes[28] is not shapes[29]
    jitter = [np.std(np.concatenate(positions)[30:], 0).sum() for positions in (held, alone)]
    assert jitter[0] < 0.95 * jitter[1]
    np.testing.assert_allclose(np.mean(held[30:], 0)[0], places[0], rtol=0.05, atol=10)


def test_a_field_of_view_is_a_camera_for_each_size_of_picture() -> None:
    view = jaxfit.FieldOfView(90.0)
    wide, small = view.of_size(1280, 720), view.of_size(640, 480)
    assert (wide.fx, wide.fy, wide.cx, wide.cy) == pytest.approx((640.0, 640.0, 639.5, 359.5))
    assert small.fx == pytest.approx(320.0)
    assert CAMERA.of_size(1, 1) is CAMERA


def test_pictures_that_could_not_be_read_have_no_camera(model: jaxfit.Model) -> None:
    """Their size is not known, whether they were given a box or not."""
    view = jaxfit.Placing(jaxfit.FieldOfView(60.0))
    fits, _, _ = seen(model, CAMERA)
    more = {"names": ("none.jpg", "a.jpg", "torn.jpg"), "sizes": np.array([[0, 0], [1280, 720], [0, 0]])}
    lost = np.concatenate([np.full((1, 68, 2), np.nan), fits.landmarks[1:]])
    pictures = np.array([2] + [1] * (COUNT - 1))
    found = jaxfit.place_heads(model, replace(fits, landmarks=lost, pictures=pictures, **more), view)
    assert found.position is not None
    assert np.isnan(found.position[0]).all()
    np.testing.assert_array_equal(found.position[1:], jaxfit.place_heads(model, fits[1:], view).position)
    nothing = jaxfit.fit(model, ["none.jpg"], [(1, 2, 30, 30)])
    assert np.isnan(jaxfit.place_heads(model, nothing, view).position).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jaxfit.PinholeCamera(0.0, 900.0, 1.0, 1.0), "focal lengths, above 0.*got 0 900 1 1"),
        (lambda: jaxfit.PinholeCamera(900.0, 900.0, float("nan"), 1.0), "got 900 900 nan 1"),
        (lambda: jaxfit.FieldOfView(180.0), "between 0 and 180 degrees; got 180"),
        (lambda: jaxfit.Placing(CAMERA, 0.0), "pupils above 0 mm; got 0"),
        (lambda: jaxfit.Placing(CAMERA).unit(jaxfit.load("face68")), "expected a model that finds heads"),
        (
            lambda: jaxfit.fitting.Tracker(jaxfit.load("face68"), placing=jaxfit.Placing(CAMERA)),
            "expected a model that finds heads",
        ),
    ],
    ids=["no focal length", "no number", "half a circle", "no pupils", "a 2D model", "a 2D tracker"],
)
def test_wrong_cameras_and_models_are_refused(make, message) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=message):
        make()
