"""``jaxfit.fit``: laws of a bundled model on the portrait that matplotlib ships, real pictures, drawn heads in 3D."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from drawn_heads import HEAD, rotation_of

import jaxfit
from jaxfit.cascade.fit import fit_crops
from jaxfit.data.boxes import bounding_square
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.fitting.batches import BATCHES
from jaxfit.fitting.fits import Problem
from jaxfit.models.model import Model
from jaxfit.shapes.space import ShapeSpace3D

KIND = "haar-frontal"


@pytest.fixture(scope="module", params=["sdm68", "fast68"])
def model(request: pytest.FixtureRequest) -> Model:
    return jaxfit.load(request.param)


@pytest.fixture(scope="module")
def box(portrait: np.ndarray) -> np.ndarray:
    (face,) = jaxfit.detect_faces(portrait, "haar")
    assert face.kind == KIND
    return face.box


@pytest.fixture(scope="module")
def landmarks(model: Model, portrait: np.ndarray, box: np.ndarray) -> np.ndarray:
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
def test_all_kinds_of_pictures_give_one_fit(
    model: Model, portrait: np.ndarray, box: np.ndarray, landmarks: np.ndarray, convert: Callable
) -> None:
    fits = jaxfit.fit(model, [convert(portrait)], [box], kind=KIND)
    np.testing.assert_allclose(fits.landmarks[0], landmarks, atol=1e-3)


def test_a_moved_picture_moves_the_fit(
    model: Model, portrait: np.ndarray, box: np.ndarray, landmarks: np.ndarray
) -> None:
    # By whole blocks of 2 or 3 pixels, which become one where faces are large; they are counted from the corner.
    moved = jaxfit.fit(model, [portrait[24:, 30:]], [box - [30, 24, 0, 0]], kind=KIND).landmarks[0]
    np.testing.assert_allclose(moved + [30, 24], landmarks, atol=0.05)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_scaled_picture_scales_the_fit(
    model: Model, portrait: np.ndarray, box: np.ndarray, landmarks: np.ndarray, factor: float
) -> None:
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    scaled = cv2.resize(portrait, None, fx=factor, fy=factor, interpolation=way)
    # Pixel centres are at integers: x becomes (x + 1/2) · factor - 1/2.
    there = np.array([*((box[:2] + 0.5) * factor - 0.5), *(box[2:] * factor)])
    fitted = (jaxfit.fit(model, [scaled], [there], kind=KIND).landmarks[0] + 0.5) / factor - 0.5
    assert apart(fitted, landmarks, landmarks) < 0.02


def test_any_number_of_faces_gives_what_one_at_a_time_gives(
    model: Model, portrait: np.ndarray, box: np.ndarray, landmarks: np.ndarray
) -> None:
    count = BATCHES[0] + BATCHES[1] + 2
    boxes = box + np.linspace(-6, 6, count)[:, None] * [1, 1, 0, 0]
    together = jaxfit.fit(model, [portrait] * count, boxes, kind=KIND).landmarks
    for number in (0, BATCHES[0], count - 1):
        alone = jaxfit.fit(model, [portrait], boxes[[number]], kind=KIND).landmarks[0]
        # Not to the last digit: rounding may move a gradient from one orientation bin to the next.
        assert apart(together[number], alone, landmarks) < 1e-3


def test_no_faces_give_no_fits(model: Model) -> None:
    fits = jaxfit.fit(model, [], [])
    assert len(fits) == 0
    assert fits.landmarks.shape == (0, 68, 2)


def test_there_is_a_row_for_each_box_as_if_each_had_a_picture_of_its_own(model: Model, portrait: np.ndarray) -> None:
    boxes = [[9000.0, 0, 9, 9], [np.nan, 0, 9, 9], [np.nan] * 4]
    fits = jaxfit.fit(model, [portrait, portrait, portrait[:0]], boxes, kind=[KIND, "square", KIND])
    assert fits.names == ("",) * 3
    assert fits.pictures.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(fits.boxes, boxes)
    assert fits.kinds == (KIND, "square", KIND)
    np.testing.assert_array_equal(fits.sizes, [portrait.shape[1::-1]] * 2 + [(0, 0)])
    assert [(problem.picture, problem.row) for problem in fits.problems] == [(0, 0), (1, 1), (2, 2)]
    assert not fits.fitted.any()


def test_wrong_arguments_are_refused(model: Model, portrait: np.ndarray, box: np.ndarray) -> None:
    with pytest.raises(jaxfit.InputError, match=r"one box .* for each of 1 images"):
        jaxfit.fit(model, [portrait], box)
    with pytest.raises(jaxfit.InputError, match="put it in a list"):
        jaxfit.fit(model, portrait, [box])
    with pytest.raises(jaxfit.InputError, match="one for each of 1 images"):
        jaxfit.fit(model, [portrait], [box], kind=[KIND, KIND])
    with pytest.raises(jaxfit.InputError, match="knows boxes of the kinds"):
        jaxfit.fit(model, [portrait], [box], kind="mine")
    with pytest.raises(jaxfit.InputError, match="at least one pass"):
        jaxfit.fit(model, [portrait], [box], passes=0)


def test_saved_and_loaded_models_fit_alike(
    model: Model, portrait: np.ndarray, box: np.ndarray, landmarks: np.ndarray, tmp_path: Path
) -> None:
    jaxfit.save(model, tmp_path / "copy.safetensors")
    copy = jaxfit.load(tmp_path / "copy.safetensors")
    fits = jaxfit.fit(copy, [portrait], [box], kind=KIND)
    np.testing.assert_array_equal(fits.landmarks[0], landmarks)
    assert fits.landmarks_3d is fits.pose is fits.scale is fits.b is None


def test_several_starts_keep_the_centroid(
    model: Model, portrait: np.ndarray, box: np.ndarray, landmarks: np.ndarray
) -> None:
    starts = jaxfit.Starts(3, -11.5, 11.5)
    crops, _ = jaxfit.crop_faces(model, [portrait], [box], kind=KIND)
    fitted = crops.to_images(np.asarray(fit_crops(model.cascade, crops.pixels, starts)))
    assert apart(fitted[0], landmarks, landmarks) < 0.05


@pytest.mark.parametrize("name", ["lfpw68", "helen68", "ytf68"])
def test_real_faces_are_fitted_from_perturbed_squares(model: Model, real_dataset: Callable, name: str) -> None:
    # The model learned from these very faces: this guards the pipeline, it measures nothing.
    faces = real_dataset(f"pts:{name}").faces[::40]
    result = jaxfit.evaluate(model, faces, start_boxes(faces))
    assert not result.fits.problems
    assert np.median(result.errors) < 0.06


def test_real_faces_are_found_and_fitted(model: Model, real_dataset: Callable) -> None:
    faces = real_dataset("pts:lfpw68").faces[::40]
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


PARTS = ("landmarks", "landmarks_3d", "pose", "scale", "b")
both_methods = pytest.mark.parametrize("method", ["alignment3d", "regression3d"])


Heads = tuple[Any, ...]  # of `FaceRecord`, all with a pose
Models = dict[str, Model]


def fit_heads(model: Model, faces: Heads) -> Any:
    """The fits of drawn heads; of any type, so that what is None for 2D models need not be."""
    images = [jaxfit.read_image(face.image) for face in faces]
    return jaxfit.fit(model, images, [bounding_square(face.landmarks) for face in faces])


def space_of(model: Model) -> ShapeSpace3D:
    assert model.space_3d is not None
    return model.space_3d


@both_methods
def test_a_head_is_the_shape_model_in_its_pose(head_models: Models, heads: Heads, method: str) -> None:
    model = space_of(head_models[method]).model
    fits = fit_heads(head_models[method], heads[:4])
    for number in range(4):
        shape = np.asarray(model.mean + np.tensordot(fits.b[number], model.modes, 1))
        seen = fits.scale[number] * rotation_of(fits.pose[number]).apply(shape)
        place = fits.landmarks_3d[number] - seen
        np.testing.assert_allclose(place, np.tile([*place[0, :2], 0], (21, 1)), atol=0.01)


@both_methods
def test_a_head_lies_on_its_landmarks(head_models: Models, heads: Heads, method: str) -> None:
    fits = fit_heads(head_models[method], heads[:4])
    apart = np.linalg.norm(fits.landmarks_3d[..., :2] - fits.landmarks, axis=2)
    if method == "regression3d":
        assert apart.max() < 1e-3
    else:
        assert 0.01 < apart.mean() < 0.03 * np.ptp(fits.landmarks, 1).max()


@both_methods
def test_drawn_heads_are_found_as_they_were_drawn(head_models: Models, heads: Heads, method: str) -> None:
    turned = sorted(heads, key=lambda face: face.pose[2])
    faces = tuple(turned[:3] + turned[-3:])
    fits = fit_heads(head_models[method], faces)
    truth = np.array([face.pose for face in faces])
    assert np.median(np.abs(fits.pose - truth)[:, 2]) < 6
    assert (np.sign(fits.pose[:, 2]) == np.sign(truth[:, 2])).all()
    # As large as the picture has them: the mean heads of drawing and fitting are the same but for their unit.
    sizes = np.array(
        [np.ptp(face.landmarks[:, 1]) / np.ptp(rotation_of(face.pose).apply(HEAD)[:, 1]) for face in faces]
    )
    unit = np.ptp(HEAD[:, 1]) / np.ptp(np.asarray(space_of(head_models[method]).model.mean)[:, 1])
    np.testing.assert_allclose(fits.scale, sizes * unit, rtol=0.1)
    depths = np.array(
        [size * rotation_of(face.pose).apply(HEAD)[:, 2] for size, face in zip(sizes, faces, strict=True)]
    )
    assert np.median(np.abs(fits.landmarks_3d[..., 2] - depths)) < 0.05 * np.ptp(depths)


@both_methods
def test_a_picture_twice_as_large_makes_the_head_twice_as_large_and_deep(
    head_models: Models, heads: Heads, method: str
) -> None:
    model, face = head_models[method], heads[0]
    once = fit_heads(model, heads[:1])
    large = cv2.resize(jaxfit.read_image(face.image), None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    # Pixel centres are at integers: x becomes (x + 1/2) · 2 - 1/2.
    twice: Any = jaxfit.fit(model, [large], [bounding_square(2 * face.landmarks + 0.5)])
    np.testing.assert_allclose(twice.scale, 2 * once.scale, rtol=0.01)
    np.testing.assert_allclose(twice.pose, once.pose, atol=1)
    np.testing.assert_allclose(twice.b, once.b, atol=0.2)
    np.testing.assert_allclose((twice.landmarks - 0.5) / 2, once.landmarks, atol=0.5)
    there = (twice.landmarks_3d - [0.5, 0.5, 0]) / 2
    np.testing.assert_allclose(there, once.landmarks_3d, atol=0.5)
    assert np.ptp(once.landmarks_3d[0, :, 2]) > 20


@both_methods
def test_3d_models_come_back_from_their_file_as_they_were(
    head_models: Models, heads: Heads, method: str, tmp_path: Path
) -> None:
    model = head_models[method]
    jaxfit.save(model, tmp_path / "heads.safetensors")
    copy = jaxfit.load(tmp_path / "heads.safetensors")
    assert copy.training == model.training
    assert (copy.training["method"], copy.training["head"]) == (method, "ict-facekit")
    assert (copy.aligned is None) == (method == "regression3d")
    assert fit_heads(model, heads[:3]) == fit_heads(copy, heads[:3])


@both_methods
def test_bad_faces_have_no_heads(head_models: Models, heads: Heads, method: str) -> None:
    model, image, box = head_models[method], jaxfit.read_image(heads[0].image), bounding_square(heads[0].landmarks)
    boxes = np.array([box, box, [9000, 0, 9, 9], box])
    fits = jaxfit.fit(model, [image, image / 255.0, image, image], boxes)
    for part in PARTS:
        values = fits.arrays[part]
        assert np.isfinite(values[[0, 3]]).all()
        assert np.isnan(values[[1, 2]]).all()
    assert [problem.row for problem in fits.problems] == [1, 2]
    away = replace(model, cascade=replace(model.cascade, biases=model.cascade.biases + np.inf))
    lost = jaxfit.fit(away, [image], [box])
    assert lost.problems == (Problem(0, "", "the fit diverged", 0),)
    assert all(np.isnan(lost.arrays[part]).all() for part in PARTS)


@both_methods
def test_no_faces_have_no_heads(head_models: Models, method: str) -> None:
    fits = jaxfit.fit(head_models[method], [], [])
    modes = space_of(head_models[method]).modes
    assert [fits.arrays[part].shape for part in PARTS] == [(0, 21, 2), (0, 21, 3), (0, 3), (0,), (0, modes)]


def test_a_refined_head_comes_nearer_to_the_landmarks(head_models: Models, heads: Heads) -> None:
    model = head_models["alignment3d"]
    aligned = fit_heads(model, heads[:3])
    refined: Any = jaxfit.refine(model, aligned)
    for name in ("landmarks", "boxes", "pictures"):
        np.testing.assert_array_equal(refined.arrays[name], aligned.arrays[name])
    assert list(refined.arrays) == list(aligned.arrays)
    before, after = (((fits.landmarks_3d[..., :2] - fits.landmarks) ** 2).sum() for fits in (aligned, refined))
    assert after < before
    np.testing.assert_allclose(refined.pose, aligned.pose, atol=10)


def test_heads_are_refined_whatever_comes_with_them(head_models: Models, heads: Heads) -> None:
    model = head_models["alignment3d"]
    outside = replace(heads[2], landmarks=heads[2].landmarks + 900)
    aligned = fit_heads(model, (*heads[:2], outside))
    assert aligned.fitted.tolist() == [True, True, False]
    refined = jaxfit.refine(model, aligned)
    assert refined.problems == aligned.problems
    np.testing.assert_array_equal(refined.fitted, aligned.fitted)
    one = jaxfit.refine(model, aligned[1])
    for name, values in one.arrays.items():
        np.testing.assert_allclose(values[0], refined.arrays[name][1], rtol=1e-3, atol=1e-3)
    assert jaxfit.refine(model, aligned[2]) == aligned[2]
    assert jaxfit.refine(model, aligned[:0]) == aligned[:0]


def test_only_alignments_can_be_refined(model: Model, head_models: Models) -> None:
    for other in (model, head_models["regression3d"]):
        with pytest.raises(jaxfit.InputError, match="only models of the method alignment3d"):
            jaxfit.refine(other, jaxfit.fit(other, [], []))
    with pytest.raises(jaxfit.InputError, match="another model's"):
        jaxfit.refine(head_models["alignment3d"], jaxfit.fit(model, [], []))
