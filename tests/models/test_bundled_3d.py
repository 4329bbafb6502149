"""The bundled 3D models on real pictures: poses as they are seen, alike in mirror images and from both methods."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="arg-type"

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import jaxfit
from jaxfit.data.boxes import bounding_square
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.pose import pose_errors
from jaxfit.shapes.pose_order import in_order

MODELS = ("alignment68-3d", "regression68-3d")
ROLL, PITCH, YAW = range(3)


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    cbook = pytest.importorskip("matplotlib.cbook")
    return jaxfit.read_image(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))


@pytest.fixture(scope="module")
def fits(portrait: np.ndarray) -> dict[str, jaxfit.Fits]:
    """Of the portrait and of its mirror image, again and again: batches of eight are compiled once for all tests."""
    (face,) = jaxfit.detect_faces(portrait)
    square = bounding_square(jaxfit.fit(jaxfit.load("sdm68"), [portrait], [face.box], kind=face.kind).landmarks[0])
    mirrored = square * [-1, 1, 1, 1] + [portrait.shape[1] - 1 - square[2], 0, 0, 0]
    pictures = [portrait, portrait[:, ::-1].copy()]
    return {name: jaxfit.fit(jaxfit.load(name), pictures * 4, [square, mirrored] * 4) for name in MODELS}


@pytest.mark.parametrize("name", MODELS)
def test_mirror_images_have_mirrored_poses(fits, name: str) -> None:
    pose, mirrored = fits[name].pose[:2]
    np.testing.assert_allclose(mirrored, pose * [-1, 1, -1], atol=10)
    # She looks at the viewer, her head a little tilted to the picture's left.
    assert np.abs(pose).max() < 25
    size = np.ptp(fits[name].landmarks[0], 0).max()
    np.testing.assert_allclose(fits[name].scale[0], fits[name].scale[1], rtol=0.05)
    assert np.abs(fits[name].landmarks_3d[0, :, :2] - fits[name].landmarks[0]).mean() < 0.02 * size
    tip, ears = fits[name].landmarks_3d[0, 30, 2], fits[name].landmarks_3d[0, [0, 16], 2]
    assert 0.3 * size < ears.mean() - tip < 1.2 * size  # the tip of the nose is nearest


def test_both_methods_see_the_same_head(fits) -> None:
    one, other = (fits[name] for name in MODELS)
    np.testing.assert_allclose(one.pose, other.pose, atol=10)
    size = np.ptp(one.landmarks[0], 0).max()
    assert np.linalg.norm(one.landmarks - other.landmarks, axis=2).mean() < 0.04 * size


@pytest.mark.parametrize("name", MODELS)
def test_is_small_and_says_what_it_is_made_of(name: str) -> None:
    assert (Path(jaxfit.__file__).parent / "models" / "bundled" / f"{name}.safetensors").stat().st_size < 10e6
    model = jaxfit.load(name)
    assert "ICT-FaceKit" in model.training["head_source"]
    assert {"square", "haar-frontal", "haar-profile", "pointing04"} <= model.placements.keys()


@pytest.mark.parametrize("name", MODELS)
def test_tells_the_pose_of_real_heads(name: str, real_dataset: Callable) -> None:
    # A guard of the pipeline on a few pictures; docs/measured/pose.md has the figures.
    faces = [face for face in real_dataset("aflw2000:aflw2000").faces if abs(face.pose[YAW]) <= 45][:448:8]
    images = [jaxfit.read_image(face.image) for face in faces]
    found = jaxfit.fit(jaxfit.load(name), images, start_boxes(faces)).pose
    truth = np.array([face.pose for face in faces])
    errors = np.abs(pose_errors(in_order(found, [face.pose_order for face in faces]), truth))
    assert np.median(errors[:, YAW]) < 6
    assert np.median(errors[:, PITCH]) < 8
    assert np.median(errors[:, ROLL]) < 4
