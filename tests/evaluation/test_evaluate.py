"""Starting boxes and evaluation: who gets which box, how faces without truth or fit are counted, errors in 3D."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="arg-type,index,operator,union-attr"

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_heads import HEAD, rotation_of, unlabelled

import jaxfit
from jaxfit.cascade.model import first_steps
from jaxfit.data.boxes import GivenBox, bounding_square
from jaxfit.data.pictures import write_image
from jaxfit.evaluation.boxes import match_boxes, start_boxes
from jaxfit.evaluation.evaluate import evaluate_steps, measure, usual_normaliser
from jaxfit.labels.records import FaceRecord
from jaxfit.schemes.known import IBUG68
from jaxfit.schemes.scheme import Scheme


def record(
    points: np.ndarray, image: Path = Path("a.png"), face: str = "a", box: np.ndarray | None = None
) -> FaceRecord:
    present = np.isfinite(points).all(1)
    return FaceRecord(image, points, present, present, box, None, face, face)


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


def test_faces_without_landmarks_start_from_their_own_boxes() -> None:
    box, none = np.array([3.0, 4.0, 20.0, 30.0]), np.zeros((0, 2))
    faces = [record(none, box=box), record(none), record(SQUARE * np.nan, box=box), record(SQUARE, box=box)]
    boxes = start_boxes(faces)
    np.testing.assert_array_equal(boxes[:3], [box, np.full(4, np.nan), box])
    np.testing.assert_array_equal(boxes[3], start_boxes([record(SQUARE)])[0])
    boxes, kinds, rotations = match_boxes(faces[:1], {"a.png": [GivenBox(box + 1, 20.0, "whole")]})
    np.testing.assert_array_equal(boxes, [box + 1])
    assert (kinds, rotations.tolist()) == (["whole"], [20.0])


def test_each_box_goes_to_one_face() -> None:
    left, right = record(SQUARE), record(SQUARE + [50, 0])
    box_left, box_right = bounding_square(SQUARE), bounding_square(SQUARE + [48, 0])
    both, kinds, rotations = match_boxes(
        [left, right], {"a.png": [GivenBox(box_right, 10.0), GivenBox(box_left, -5.0)]}
    )
    np.testing.assert_array_equal(both, [box_left, box_right])
    assert (kinds, rotations.tolist()) == (["square"] * 2, [-5.0, 10.0])
    one, _, _ = match_boxes([left, right], {"a.png": [GivenBox(box_right, 0.0)]})
    assert np.isnan(one[0]).all()
    np.testing.assert_array_equal(one[1], box_right)
    assert np.isnan(match_boxes([left], {"b.png": [GivenBox(box_left, 0.0)]})[0]).all()


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
    assert result.fits.pose is result.errors_3d is None
    assert np.isnan(result.ordered_pose).all()
    assert np.isfinite(result.errors[:2]).all()
    assert np.isnan(result.errors[2])
    assert result.errors[3] == np.inf
    assert [problem.row for problem in result.fits.problems] == [3]
    assert result.seconds_per_face > 0


@pytest.mark.parametrize(
    ("scheme", "yaws", "expected"),
    [
        (IBUG68, [None, 44.0, np.nan], "outer"),
        (IBUG68, [None, 0.0, -46.0], "box"),
        (Scheme("own", 3), [None], "box"),
    ],
    ids=["faces", "turned faces", "no eyes"],
)
def test_errors_are_relative_to_what_the_faces_have(scheme: Scheme, yaws: list, expected: str) -> None:
    poses = [None if yaw is None else np.array([0.0, 0.0, yaw]) for yaw in yaws]
    seen = np.ones(scheme.count, bool)
    points = np.zeros((scheme.count, 2))
    faces = [FaceRecord(Path("a.png"), points, seen, seen, None, pose, "a", "a") for pose in poses]
    assert usual_normaliser(scheme, faces) == expected


def test_faces_of_other_landmarks_are_refused() -> None:
    with pytest.raises(jaxfit.InputError, match="finds 68 landmarks"):
        jaxfit.evaluate(jaxfit.load("sdm68"), [record(SQUARE)], np.zeros((1, 4)))


@pytest.mark.parametrize("method", ["alignment3d", "regression3d"])
def test_errors_of_heads_are_those_of_the_heads_that_were_drawn(head_models, heads, method) -> None:
    faces = (*heads[:4], replace(heads[4], image=Path("missing.png")))
    result = jaxfit.evaluate(head_models[method], faces, start_boxes(faces))
    np.testing.assert_array_equal(result.true_pose, [face.pose for face in faces])
    np.testing.assert_array_equal(result.ordered_pose[:4], result.fits.pose[:4])
    assert np.isnan(result.fits.pose[4]).all()
    assert result.errors[4] == result.errors_3d[4] == np.inf
    # What the depths add: the fits' against those drawn.
    fits = jaxfit.fit(head_models[method], [jaxfit.read_image(face.image) for face in faces[:4]], result.fits.boxes[:4])
    truth = []
    for face in faces[:4]:
        drawn = rotation_of(face.pose).apply(HEAD)
        truth.append(drawn * np.ptp(face.landmarks[:, 1]) / np.ptp(drawn[:, 1]))
        truth[-1][:, :2] = face.landmarks
    eyes = np.linalg.norm([face[6] - face[11] for face in truth], axis=1)
    expected = np.linalg.norm(fits.landmarks_3d - truth, axis=2).mean(1) / eyes
    np.testing.assert_allclose(result.errors_3d[:4], expected, atol=0.02)
    assert (result.errors_3d[:4] > result.errors[:4]).sum() >= 3


def test_poses_are_measured_without_landmarks(head_models, heads) -> None:
    faces = [unlabelled(face) for face in heads[:5]]
    faces[1] = replace(faces[1], pose=np.array([np.nan, *faces[1].pose[1:]]))
    faces[2] = replace(faces[2], pose=None, box=None)
    other = rotation_of(faces[3].pose).as_euler("XYZ", degrees=True)  # about axes that turn with the head
    faces[3] = replace(faces[3], pose=np.array([other[2], -other[0], other[1]]), pose_order="roll-yaw-pitch")
    boxes = start_boxes(faces)
    np.testing.assert_array_equal(boxes[[0, 1, 3, 4]], [faces[n].box for n in (0, 1, 3, 4)])
    result = jaxfit.evaluate(head_models["regression3d"], faces, boxes)
    assert np.isnan(result.errors).all()
    assert np.isnan(result.errors_3d).all()
    assert [problem.row for problem in result.fits.problems] == [2]
    assert result.landmarks.shape == (5, 21, 2)
    np.testing.assert_array_equal(
        np.isnan(result.true_pose)[:4], [[False] * 3, [True, False, False], [True] * 3, [False] * 3]
    )
    np.testing.assert_array_equal(result.ordered_pose[:3], result.fits.pose[:3])
    np.testing.assert_allclose(result.ordered_pose[[0, 3]], result.true_pose[[0, 3]], atol=12)
    same = rotation_of(result.fits.pose[3]).as_euler("XYZ", degrees=True)
    np.testing.assert_allclose(result.ordered_pose[3], [same[2], -same[0], same[1]], atol=1e-3)


def test_no_faces_have_no_errors(head_models) -> None:
    result = jaxfit.evaluate(head_models["regression3d"], [], np.zeros((0, 4)))
    shapes = [
        part.shape
        for part in (result.errors, result.errors_3d, result.fits.pose, result.true_pose, result.ordered_pose)
    ]
    assert shapes == [(0,), (0,), (0, 3), (0, 3), (0, 3)]


def test_3d_errors_are_not_measured_on_landmarks_of_another_scheme(head_models, heads) -> None:
    # 68 points that no cascade finds in time, converted to the labels' 21.
    model, rng = replace(head_models["regression3d"], scheme=IBUG68), np.random.default_rng(0)
    fits = jaxfit.Fits(
        scheme=IBUG68,
        names=("a", "b"),
        sizes=np.full((2, 2), 140),
        pictures=np.arange(2),
        boxes=np.ones((2, 4)),
        kinds=("square",) * 2,
        rotations=np.zeros(2),
        landmarks=rng.normal(size=(2, 68, 2)),
        landmarks_3d=rng.normal(size=(2, 68, 3)),
        pose=np.ones((2, 3)),
        scale=np.ones(2),
        b=np.ones((2, 1)),
    )
    result = measure(fits, heads[:2], scheme=head_models["regression3d"].scheme, model=model)
    assert np.isfinite(result.errors).all()
    assert np.isnan(result.errors_3d).all()
    assert result.fits == fits
    with pytest.raises(jaxfit.InputError, match="a fit for each of 3 faces; got 2"):
        measure(fits, heads[:3], scheme=head_models["regression3d"].scheme)


@pytest.mark.parametrize("method", ["alignment3d", "regression3d"])
def test_every_step_is_what_a_cascade_of_so_many_steps_tells(head_models, heads, method: str) -> None:
    model, faces = head_models[method], [*heads[:3], replace(heads[3], image=Path("missing.png"))]
    boxes = start_boxes(faces)
    results = evaluate_steps(model, faces, boxes)
    assert len(results) == len(model.cascade.windows)
    for steps, result in enumerate(results, 1):
        short = replace(model, cascade=first_steps(model.cascade, steps))
        alone = jaxfit.evaluate(short, faces, boxes)
        for name in ("errors", "errors_3d", "landmarks"):
            np.testing.assert_array_equal(getattr(result, name), getattr(alone, name))
        assert result.fits.problems == alone.fits.problems
        assert np.isinf(result.errors[3])


def test_no_picture_that_can_be_read_or_no_face_at_all(head_models, heads) -> None:
    model, lost = head_models["regression3d"], [replace(heads[0], image=Path("missing.png"))]
    assert len(evaluate_steps(model, lost, start_boxes(lost))) == len(model.cascade.windows)
    for faces in (lost, []):
        for result in evaluate_steps(model, faces, start_boxes(faces)):
            assert len(result.errors) == len(faces)
            assert np.isinf(result.errors).all()
