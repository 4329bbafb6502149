"""``jaxfit.fit`` with the bundled model: laws on the portrait that matplotlib ships, and accuracy on real pictures."""

from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfit
from jaxfit.evaluating import start_boxes
from jaxfit.fitting import BATCHES

KIND = "haar-frontal"


@pytest.fixture(scope="module")
def model() -> jaxfit.Model:
    return jaxfit.load("sdm68")


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    cbook = pytest.importorskip("matplotlib.cbook")
    return jaxfit.read_image(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))


@pytest.fixture(scope="module")
def box(portrait: np.ndarray) -> np.ndarray:
    (face,) = jaxfit.detect_faces(portrait)
    assert face.kind == KIND
    return face.box


@pytest.fixture(scope="module")
def landmarks(model: jaxfit.Model, portrait: np.ndarray, box: np.ndarray) -> np.ndarray:
    return jaxfit.fit(model, [portrait], [box], kind=KIND).landmarks[0]


def apart(one: np.ndarray, other: np.ndarray, landmarks: np.ndarray) -> float:
    """Mean distance of two fits, as a share of the distance of the outer eye corners."""
    return float(np.linalg.norm(one - other, axis=1).mean() / np.linalg.norm(landmarks[36] - landmarks[45]))


def test_the_portrait_is_fitted(landmarks: np.ndarray, box: np.ndarray) -> None:
    eyes, nose, mouth, chin = landmarks[36:48], landmarks[27:36], landmarks[48:68], landmarks[8]
    assert eyes[:, 1].max() < nose[4:, 1].min() < mouth[:, 1].min() < chin[1]
    assert eyes[:6, 0].max() < nose[:, 0].mean() < eyes[6:, 0].min()
    assert (landmarks > box[:2] - 0.3 * box[2:]).all()
    assert (landmarks < box[:2] + 1.3 * box[2:]).all()


@pytest.mark.parametrize(
    "convert",
    [
        lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY),
        lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA),
        lambda rgb: rgb.astype(np.uint16) * 257,
    ],
    ids=["grey", "alpha", "16 bits"],
)
def test_all_kinds_of_pictures_give_one_fit(model, portrait, box, landmarks, convert) -> None:
    fits = jaxfit.fit(model, [convert(portrait)], [box], kind=KIND)
    np.testing.assert_allclose(fits.landmarks[0], landmarks, atol=1e-3)


def test_a_moved_picture_moves_the_fit(model, portrait, box, landmarks) -> None:
    moved = jaxfit.fit(model, [portrait[20:, 30:]], [box - [30, 20, 0, 0]], kind=KIND).landmarks[0]
    np.testing.assert_allclose(moved + [30, 20], landmarks, atol=0.05)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_scaled_picture_scales_the_fit(model, portrait, box, landmarks, factor) -> None:
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    scaled = cv2.resize(portrait, None, fx=factor, fy=factor, interpolation=way)
    # Pixel centres are at integers: x becomes (x + 1/2) · factor - 1/2.
    there = np.array([*((box[:2] + 0.5) * factor - 0.5), *(box[2:] * factor)])
    fitted = (jaxfit.fit(model, [scaled], [there], kind=KIND).landmarks[0] + 0.5) / factor - 0.5
    assert apart(fitted, landmarks, landmarks) < 0.02


def test_any_number_of_faces_gives_what_one_at_a_time_gives(model, portrait, box, landmarks) -> None:
    count = BATCHES[0] + BATCHES[1] + 2
    boxes = box + np.linspace(-6, 6, count)[:, None] * [1, 1, 0, 0]
    together = jaxfit.fit(model, [portrait] * count, boxes, kind=KIND).landmarks
    for number in (0, BATCHES[0], count - 1):
        alone = jaxfit.fit(model, [portrait], boxes[[number]], kind=KIND).landmarks[0]
        # Not to the last digit: rounding may move a gradient from one orientation bin to the next.
        assert apart(together[number], alone, landmarks) < 1e-3


def test_no_faces_give_no_fits(model) -> None:
    fits = jaxfit.fit(model, [], [])
    assert len(fits) == 0
    assert fits.landmarks.shape == (0, 68, 2)


def test_bad_faces_do_not_stop_the_others(model, portrait, box, landmarks) -> None:
    images = [portrait, portrait, portrait / 255.0, portrait[:0], portrait, portrait]
    boxes = [box, [np.nan, 0, 9, 9], box, box, [9000, 0, 9, 9], [0, 0, 0, 9]]
    fits = jaxfit.fit(model, images, boxes, kind=KIND)
    assert fits.ok.tolist() == [True] + [False] * 5
    assert apart(fits.landmarks[0], landmarks, landmarks) < 1e-3
    assert set(fits.problems) == {1, 2, 3, 4, 5}
    for number, words in {1: "finite", 2: "uint8", 3: "pixel", 4: "outside", 5: "no area"}.items():
        assert words in fits.problems[number]


def test_wrong_arguments_are_refused(model, portrait, box) -> None:
    with pytest.raises(jaxfit.InputError, match=r"one box .* for each of 1 images"):
        jaxfit.fit(model, [portrait], box)
    with pytest.raises(jaxfit.InputError, match="put it in a list"):
        jaxfit.fit(model, portrait, [box])
    with pytest.raises(jaxfit.InputError, match="one for each of 1 images"):
        jaxfit.fit(model, [portrait], [box], kind=[KIND, KIND])
    with pytest.raises(jaxfit.InputError, match="knows boxes of the kinds"):
        jaxfit.fit(model, [portrait], [box], kind="mine")


def test_saved_and_loaded_models_fit_alike(model, portrait, box, landmarks, tmp_path: Path) -> None:
    jaxfit.save(model, tmp_path / "copy.safetensors")
    copy = jaxfit.load(tmp_path / "copy.safetensors")
    np.testing.assert_array_equal(jaxfit.fit(copy, [portrait], [box], kind=KIND).landmarks[0], landmarks)


def test_several_starts_keep_the_centroid(model, portrait, box, landmarks) -> None:
    crops, _ = jaxfit.crop_faces(model, [portrait], [box], kind=KIND)
    rotations = jnp.array([-0.2, 0.0, 0.2])
    fitted = crops.to_images(np.asarray(jaxfit.fit_crops(model.cascade, jnp.asarray(crops.pixels), rotations)))
    assert apart(fitted[0], landmarks, landmarks) < 0.05


@pytest.mark.parametrize("name", ["lfpw68", "helen68", "ytf68"])
def test_real_faces_are_fitted_from_perturbed_squares(model, shared_data: Path, name: str) -> None:
    # The model learned from these very faces: this guards the pipeline, it measures nothing.
    faces = jaxfit.read_dataset(f"pts:{shared_data / name}").faces[::40]
    result = jaxfit.evaluate(model, faces, start_boxes(faces))
    assert not result.problems
    assert np.median(result.errors) < 0.06


def test_real_faces_are_found_and_fitted(model, shared_data: Path) -> None:
    faces = jaxfit.read_dataset(f"pts:{shared_data / 'lfpw68'}").faces[::40]
    images = [jaxfit.read_image(face.image) for face in faces]
    found = [jaxfit.detect_faces(image) for image in images]
    # Pictures of several people: which of them is labelled is not the detector's to know.
    single = [i for i in range(len(faces)) if len(found[i]) == 1]
    assert len(single) > 0.6 * len(faces)
    fits = jaxfit.fit(
        model, [images[i] for i in single], [found[i][0].box for i in single], kind=[found[i][0].kind for i in single]
    )
    errors = [apart(fits.landmarks[k], faces[i].landmarks, faces[i].landmarks) for k, i in enumerate(single)]
    assert np.median(errors) < 0.07
