"""Fine-tuning models on labelled faces: in 2D and 3D, with hidden points, people kept aside, killed and resumed."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="arg-type"

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from drawn_heads import OPTIONS
from jax import numpy as jnp
from jax import random

import jaxfit
from jaxfit.cascade import tuning as finetune
from jaxfit.data.boxes import bounding_square, jitter
from jaxfit.data.pictures import read_grey
from jaxfit.errors import InputError, ModelError
from jaxfit.heads.model import load_head_model, save_head_model
from jaxfit.image.disturb import Disturbance
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.finetune import _kept_aside, retuned
from jaxfit.learning.prepare import cut_labelled, training_set
from jaxfit.schemes.known import AFLW21

MILD = Disturbance(0.05, 0.03, 0.0, 0.1, 1.0, 0.1)
TUNING = jaxfit.Tuning(epochs=2, batch=8, dropped=0.1, disturbance=MILD)


@pytest.fixture(scope="module")
def cautious(heads) -> jaxfit.Model:
    """SDM that has learned too little."""
    return jaxfit.train(heads, AFLW21, options=OPTIONS.but(ridge=30.0)).model


def test_what_comes_out(cautious, heads, tmp_path: Path) -> None:
    model = replace(cautious, training=cautious.training | {"note": "kept"})
    tuned = jaxfit.finetune(model, heads, tuning=replace(TUNING, epochs=8), validation=0.25)
    assert (tuned.faces, tuned.problems) == (24, ())
    assert tuned.errors.shape == (9,)
    assert tuned.errors.min() < 0.9 * tuned.errors[0]
    assert tuned.model.training["note"] == "kept"
    made = tuned.model.training["finetuned"]
    assert (made["epochs"], made["faces"], made["disturbance"]["noise"]) == (8, 24, 1.0)
    jaxfit.save(tuned.model, tmp_path / "tuned.safetensors")
    again = jaxfit.load(tmp_path / "tuned.safetensors")
    pictures, boxes = [face.image for face in heads], [bounding_square(face.landmarks) for face in heads]
    np.testing.assert_array_equal(
        jaxfit.fit(again, pictures, boxes).landmarks, jaxfit.fit(tuned.model, pictures, boxes).landmarks
    )


def test_in_3d_shapes_and_poses_are_learned(head_models, heads) -> None:
    model = head_models["regression3d"]
    tuned = jaxfit.finetune(model, heads, tuning=replace(TUNING, epochs=12), validation=0.25)
    assert tuned.errors[-1] < 0.7 * tuned.errors[0]
    # From boxes that are far off: the greedy cascade is good at all others.
    rng = np.random.default_rng(0)
    boxes = [jitter(bounding_square(face.landmarks), rng, 0.12, 0.15) for face in heads]
    pictures, poses = [face.image for face in heads], np.stack([face.pose for face in heads])
    before, after = (jaxfit.fit(each, pictures, boxes).pose for each in (model, tuned.model))
    assert np.abs(after - poses).mean() < 0.9 * np.abs(before - poses).mean()


@pytest.mark.parametrize("method", ["regression3d", "alignment3d"])
def test_gradients_of_shape_models_are_those_of_finite_differences(head_models, heads, method: str) -> None:
    cascade = head_models[method].cascade
    crops, landmarks, _ = crops_of(head_models[method], heads[:4])
    faces = training_set(crops, landmarks, np.stack([bounding_square(each) for each in landmarks]), np.arange(4), None)
    batch = finetune._batch_of(faces, finetune._depths(cascade, faces), np.arange(4))
    drawn = finetune._Drawn(0.5 * head_models[method].placement("square").spread.sigmas, jnp.float32(0))
    states = finetune._starts(cascade, random.split(random.key(0), 4), batch.pivots, drawn)
    levels = finetune._levels(cascade)
    # What is seen has its own test; SIFT, whose bins have borders, would hide small errors of the shape model's here.
    cascade = replace(cascade, weights=tuple(map(jnp.zeros_like, cascade.weights)))

    @jax.jit
    def loss(by):
        moved = replace(cascade, biases=cascade.biases + by)
        return finetune._loss(moved, levels, batch, states, random.key(1), 0.0)

    slopes = jax.grad(loss)(jnp.zeros_like(cascade.biases))
    step = 0.01 * jnp.linalg.norm(cascade.biases) / jnp.linalg.norm(slopes) * slopes
    one, two = (loss(by) - loss(-by) for by in (0.5 * step, step))
    np.testing.assert_allclose((8 * one - two) / 6, jnp.vdot(slopes, step), rtol=0.02)


def test_depths_stay_those_of_the_disturbed_picture(head_models, heads) -> None:
    """A head that is turned in the picture and scaled is as deep as one that was seen so."""
    model = head_models["regression3d"]
    crops, landmarks, _ = crops_of(model, heads[:4])
    faces = training_set(crops, landmarks, np.stack([bounding_square(each) for each in landmarks]), np.arange(4), None)
    # Landmarks that a head of the shape model has, seen by a camera.
    space = model.cascade.space
    seen = jax.vmap(lambda points: space.landmarks(space.encode(points)))(jnp.asarray(faces.landmarks))
    faces = replace(faces, landmarks=np.asarray(seen))
    batch = finetune._batch_of(faces, finetune._depths(model.cascade, faces), np.arange(4))
    amounts = Disturbance(0.4, 0.3, 0.0, 0.0, 0.0, 0.0)
    disturbed = finetune._disturbed(random.key(0), batch, amounts)
    again = finetune._depths(model.cascade, replace(faces, landmarks=np.asarray(disturbed.landmarks)))
    ratio = np.ptp(again, axis=1) / np.ptp(batch.depths, axis=1)
    assert np.abs(ratio - 1).max() > 0.1
    np.testing.assert_allclose(disturbed.depths, again, atol=0.01)


def crops_of(model: jaxfit.Model, faces: Sequence[FaceRecord]) -> tuple[Any, np.ndarray, list[str]]:
    """The crops of faces, and their labels in pictures."""
    landmarks = np.stack([face.landmarks for face in faces])
    squares = np.stack([bounding_square(each) for each in landmarks])
    crops, _, problems, _ = cut_labelled(
        faces, squares, model.placement("square"), model.cascade.frame, read_grey, lambda *_: None
    )
    return crops, landmarks, problems


def partly(face: FaceRecord, present: np.ndarray) -> FaceRecord:
    """The face with some landmarks unknown."""
    return replace(face, landmarks=np.where(present[:, None], face.landmarks, np.nan), present=present)


def test_hidden_landmarks(cautious, heads) -> None:
    hidden = heads[0].present.copy()
    hidden[:3] = False
    faces = [partly(face, hidden) if n % 2 else face for n, face in enumerate(heads)]
    tuned = jaxfit.finetune(cautious, faces, tuning=TUNING, validation=0.25)
    assert tuned.faces == 24
    assert np.isfinite(tuned.errors).all()
    few = hidden.copy()
    few[:15] = False
    tuned = jaxfit.finetune(cautious, [partly(heads[0], few), *heads[1:]], tuning=TUNING, validation=0.25)
    assert tuned.problems == ("1 of 1 faces left out: fewer than 8 labelled points, or all on a line",)


def test_landmarks_of_nan_are_missing_whatever_is_said_of_them(cautious, heads) -> None:
    some = np.arange(21) > 3
    said = [partly(face, some) if number % 2 else face for number, face in enumerate(heads)]
    unsaid = [replace(face, present=np.ones(21, bool)) for face in said]
    assert [face.complete for face in unsaid[:2]] == [True, False]
    one, other = (jaxfit.finetune(cautious, faces, tuning=TUNING, validation=0.0).model for faces in (said, unsaid))
    np.testing.assert_array_equal(one.cascade.weights[0], other.cascade.weights[0])


def test_guessed_landmarks_do_not_count(cautious, heads) -> None:
    guessed = np.isin(np.arange(21), [7, 10, 14, 18])  # in the middle: the face's square stays what it is
    wrong = [face.landmarks + 5.0 * guessed[:, None] for face in heads]
    faces = [replace(face, landmarks=points, present=~guessed) for face, points in zip(heads, wrong, strict=True)]
    boxes = [bounding_square(face.landmarks) for face in heads]
    truth = np.stack([face.landmarks for face in heads])
    moved = []
    for labels in (faces, [replace(face, present=np.ones(21, bool)) for face in faces]):
        tuned = jaxfit.finetune(cautious, labels, tuning=replace(TUNING, epochs=10), validation=0.0).model
        found = jaxfit.fit(tuned, [face.image for face in heads], boxes).landmarks
        moved.append((found - truth)[:, guessed].mean())
    assert abs(moved[0]) < 0.5
    assert moved[1] > 2.0


def test_guessed_landmarks_count_where_that_is_asked_for(cautious, heads) -> None:
    """Landmarks that nobody labelled stay near where the head model has them, though the others are labelled wrong."""
    hidden = np.arange(21) < 6
    faces = [partly(face, ~hidden) for face in heads]
    quiet = replace(TUNING, epochs=6)
    alone, guided = (
        jaxfit.finetune(cautious, faces, tuning=replace(quiet, guessed=share), validation=0.0).model
        for share in (0.0, 1.0)
    )
    truth = np.stack([face.landmarks for face in heads])
    boxes = [bounding_square(face.landmarks) for face in heads]
    errors = [
        np.linalg.norm(jaxfit.fit(model, [face.image for face in heads], boxes).landmarks - truth, axis=2)
        for model in (cautious, alone, guided)
    ]
    of_hidden = [each[:, hidden].mean() for each in errors]
    assert of_hidden[2] < min(of_hidden[:2])


def test_yaws_are_balanced(cautious, heads, monkeypatch) -> None:
    shares = []

    def watched(cascade, faces, *_, **__):
        shares.append(faces.shares)
        return cascade, []

    module = import_module("jaxfit.learning.finetune")
    monkeypatch.setattr(module, "finetune_cascade", watched)
    for balance in (0.0, 1.0):
        jaxfit.finetune(cautious, heads, tuning=replace(TUNING, balance=balance), validation=0.0)
    assert shares[0] is None
    of_faces = shares[1][: len(heads)]
    np.testing.assert_array_equal(shares[1][len(heads) :], of_faces)  # their mirror images
    bands = np.abs([face.pose[2] for face in heads]) // 15
    own = {band: of_faces[bands == band].sum() for band in set(bands)}
    # The head model's yaws, not the labelled ones, make the bands.
    assert max(own.values()) < 3 * min(own.values())


def test_people_are_kept_aside_whole() -> None:
    subjects = [f"person {n % 10}" for n in range(40)]
    aside = _kept_aside(subjects, 0.25, 0)
    assert len({name for name, kept in zip(subjects, aside, strict=True) if kept}) == 3
    assert aside.sum() == 12
    np.testing.assert_array_equal(aside, _kept_aside(subjects, 0.25, 0))
    assert not np.array_equal(aside, _kept_aside(subjects, 0.25, 1))
    assert not _kept_aside(subjects, 0.0, 0).any()
    assert _kept_aside(["a", "b"], 0.01, 0).sum() == 1


def test_a_killed_run_goes_on(cautious, heads, tmp_path: Path) -> None:
    class Killed(Exception):
        pass

    def kill(stage: str, done: int, total: int) -> None:
        if stage == "fine-tuning" and done > total / 2:
            raise Killed

    file = tmp_path / "unfinished"
    with pytest.raises(Killed):
        jaxfit.finetune(cautious, heads, tuning=TUNING, checkpoint=file, progress=kill)
    assert [path.name for path in tmp_path.iterdir()] == ["unfinished"]
    seen: list[int] = []
    resumed = jaxfit.finetune(
        cautious, heads, tuning=TUNING, checkpoint=file, progress=lambda stage, done, total: seen.append(done / total)
    )
    first = seen.index(1.0) + 1  # all pictures have been read
    assert seen[first] == 0.5
    whole = jaxfit.finetune(cautious, heads, tuning=TUNING)
    np.testing.assert_array_equal(resumed.errors, whole.errors)
    np.testing.assert_array_equal(resumed.model.cascade.weights[0], whole.model.cascade.weights[0])
    with pytest.raises(InputError, match="a checkpoint of other faces, settings or another model"):
        jaxfit.finetune(cautious, heads, tuning=replace(TUNING, rate=0.01), checkpoint=file)
    with pytest.raises(InputError, match="a checkpoint of other faces"):
        jaxfit.finetune(cautious, heads[:-1], tuning=TUNING, checkpoint=file)
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(ModelError, match="not a checkpoint, or damaged"):
        jaxfit.finetune(cautious, heads, tuning=TUNING, checkpoint=file)


def test_models_are_fine_tuned_alike(cautious, heads) -> None:
    assert retuned(cautious, cautious, heads) is cautious
    tuned = jaxfit.finetune(cautious, heads, tuning=TUNING, validation=0.25).model
    again = retuned(cautious, tuned, heads)
    np.testing.assert_array_equal(again.cascade.weights[0], tuned.cascade.weights[0])
    assert again.training == tuned.training
    silent = replace(tuned, training=tuned.training | {"finetuned": {"epochs": 2}})
    with pytest.raises(InputError, match="expected a model that says how it was fine-tuned"):
        retuned(cautious, silent, heads)


def test_starts_are_turned_as_the_model_was_made_for(cautious, heads, monkeypatch) -> None:
    turns = []

    def watched(cascade, *_, turn, **__):
        turns.append(turn)
        return cascade, []

    # The package has a function of the module's name.
    module = import_module("jaxfit.learning.finetune")
    monkeypatch.setattr(module, "finetune_cascade", watched)
    for told in ({}, {"initialisations": 3, "rotations": [-40.0, 40.0]}):
        jaxfit.finetune(replace(cautious, training=cautious.training | told), heads, validation=0.0)
    assert turns == [0.0, pytest.approx(np.radians(0.7 * 80))]


def test_a_head_model_of_ones_own_places_faces(cautious, heads, tmp_path: Path) -> None:
    some = np.arange(21) > 3
    hidden = [partly(face, some) for face in heads]
    with pytest.raises(ModelError, match="mine"):
        jaxfit.finetune(cautious, hidden, head_model=tmp_path / "mine.safetensors")
    save_head_model(load_head_model(), tmp_path / "mine.safetensors")
    own = jaxfit.finetune(
        cautious, hidden, tuning=TUNING, validation=0.0, head_model=tmp_path / "mine.safetensors"
    ).model
    bundled = jaxfit.finetune(cautious, hidden, tuning=TUNING, validation=0.0).model
    np.testing.assert_allclose(own.cascade.weights[0], bundled.cascade.weights[0], atol=1e-6)


def test_wrong_arguments(cautious, heads, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected labels of 21 landmarks"):
        jaxfit.finetune(cautious, [replace(heads[0], landmarks=np.zeros((5, 2)))])
    with pytest.raises(InputError, match="0 <= validation < 1; got 1"):
        jaxfit.finetune(cautious, heads, validation=1.0)
    with pytest.raises(InputError, match="at least two faces that can be learned from; got 1"):
        jaxfit.finetune(cautious, heads[:1])
    with pytest.raises(InputError, match="two people or more"):
        jaxfit.finetune(cautious, [replace(face, subject="one") for face in heads])
    sided = replace(cautious, scheme=replace(AFLW21, mirror=None))
    with pytest.raises(InputError, match="no mirror order"):
        jaxfit.finetune(sided, [replace(face, image=Path("unread.png")) for face in heads])
    missing = [replace(face, image=tmp_path / "missing.png") for face in heads]
    with pytest.raises(InputError, match="at least two readable pictures; got 0"):
        jaxfit.finetune(cautious, missing)


def test_what_was_learned_from_is_kept(cautious, heads) -> None:
    before = cautious.learned
    tuned = jaxfit.finetune(replace(cautious, learned=before[:10]), heads[16:], tuning=TUNING).model
    assert len(tuned.learned) >= 16
    assert np.isin(before[:10], tuned.learned).all()
    assert jaxfit.finetune(replace(cautious, learned=None), heads[16:], tuning=TUNING).model.learned is None
