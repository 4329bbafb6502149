"""Which faces training takes, and what it says of the others; what it learns is tested through the commands."""

from pathlib import Path

import numpy as np
import pytest

from jaxfit.errors import InputError
from jaxfit.heads.model import load_head_model
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.methods import Options, options_for
from jaxfit.learning.train import train
from jaxfit.schemes.known import AFLW21, NO_LANDMARKS
from jaxfit.schemes.scheme import Scheme

FACE = 20 * np.asarray(load_head_model().of(AFLW21, 0.5).mean)[:, :2].astype(float) + 200


def record(name: str, landmarks: np.ndarray) -> FaceRecord:
    seen = np.ones(len(landmarks), bool)
    return FaceRecord(Path(f"{name}.png"), landmarks, seen, seen, None, None, name, name)


def complaints(*faces: FaceRecord) -> str:
    """What is said before it is noticed that none of the pictures is there."""
    with pytest.raises(InputError, match="at least two readable pictures; got 0") as raised:
        train(faces, AFLW21, method="regression3d")
    return str(raised.value)


@pytest.mark.parametrize(
    ("scheme", "faces", "copies"),
    [(AFLW21, 10, 0), (Scheme("points9", 9), 10, 9), (Scheme("points9", 9), 95, 3), (Scheme("points9", 9), 9999, 0)],
)
def test_few_objects_of_ones_own_are_learned_from_several_times(scheme: Scheme, faces: int, copies: int) -> None:
    options = options_for(scheme, faces)
    assert options.greedy.copies == copies
    assert (options == Options()) == (scheme == AFLW21)
    assert options.mirror == (scheme == AFLW21)


def test_labels_on_a_line_are_left_out_and_reported() -> None:
    line, point = FACE * [1, 0] + FACE[:, :1] * [0, 0.5], np.full_like(FACE, 7.0)
    narrow = FACE * [0.05, 1]  # squeezed, but a face
    faces = (line, point, narrow, FACE, FACE, FACE)
    said = complaints(*(record(name, face) for name, face in zip("abcdef", faces, strict=True)))
    assert "a.png: all landmarks lie on a line; b.png: all landmarks lie in one point; c.png: cannot be read" in said


@pytest.mark.parametrize(
    "shape", [[[0, 0], [9, 0]], [[0, 5], [9, 5], [20, 5], [30, 5.1]]], ids=["two points", "four near a line"]
)
def test_landmarks_that_lie_on_a_line_on_every_picture_are_no_mistake(shape: list[list[float]]) -> None:
    scheme = Scheme("own", len(shape))
    pictures = [record(name, np.array(shape, float)) for name in "ab"]
    with pytest.raises(InputError, match=r"readable pictures; got 0: a\.png: cannot be read"):
        train(pictures, scheme, options=Options(mirror=False))


@pytest.mark.parametrize(("method", "fewest"), [("sdm", 2), ("parametric", 3)])
def test_too_few_landmarks_are_refused_before_the_work(method: str, fewest: int) -> None:
    faces = [record(name, np.arange(2.0 * fewest - 2).reshape(-1, 2)) for name in "ab"]
    scheme = Scheme("own", fewest - 1)
    with pytest.raises(InputError, match=f"at least {fewest} landmarks for the method {method!r}.*has {fewest - 1}"):
        train(faces, scheme, method=method, options=Options(mirror=False))


def test_faces_without_landmarks_are_no_training_data() -> None:
    with pytest.raises(InputError, match="expected faces with landmarks to learn from"):
        train([record("a", np.zeros((0, 2)))] * 3, NO_LANDMARKS)
