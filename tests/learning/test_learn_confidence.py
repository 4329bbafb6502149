"""Teaching a confidence: starts are what they are called, what is learned is calibrated, and fits tell it."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="arg-type,call-arg,index"

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from drawn_heads import OPTIONS
from jax import numpy as jnp
from safetensors.numpy import load as unpack
from safetensors.numpy import save as pack

import jaxfit
from jaxfit.cascade.confidence import Clues, Confidence
from jaxfit.cascade.regression import Projection
from jaxfit.data.boxes import bounding_square
from jaxfit.data.pictures import read_image
from jaxfit.errors import InputError, ModelError
from jaxfit.evaluation.calibration import auroc, calibration_error
from jaxfit.learning import confidence as trusting
from jaxfit.learning.confidence import SampledFits, learn_confidence, sample_fits
from jaxfit.learning.draw_starts import DETECTED, ELSEWHERE, LOST, NO_FACES, PART, PATTERN, box_of_start
from jaxfit.schemes.known import AFLW21

SQUARE = np.array([60.0, 50, 80, 80])
PICTURE = (300, 400)


@pytest.fixture(scope="module")
def model(heads) -> jaxfit.Model:
    """Of SDM on drawn heads, taught by two folds."""
    trained = jaxfit.train(heads, AFLW21, options=OPTIONS).model
    return learn_confidence(trained, heads, folds=2)


def test_fits_tell_their_confidence(model, heads) -> None:
    pictures = [face.image for face in heads] + [np.full((140, 140), 90, np.uint8)] * 8 + ["nowhere.png"]
    boxes = [bounding_square(face.landmarks) for face in heads] + [np.array([30.0, 30, 80, 80])] * 9
    fits = jaxfit.fit(model, pictures, boxes)
    faces, blank = fits.confidence[: len(heads)], fits.confidence[len(heads) : -1]
    assert np.median(faces) > 0.5 > blank.max()
    assert np.isnan(fits.confidence[-1])
    np.testing.assert_array_equal(fits.fitted, [True] * (len(heads) + 8) + [False])
    np.testing.assert_array_equal(fits.ok, np.nan_to_num(fits.confidence) >= 0.5)
    assert fits.covariances is not None
    assert fits.visible is not None
    assert fits.covariances.shape == (len(fits), 21, 2, 2)
    assert fits.visible.shape == (len(fits), 21)
    assert (np.linalg.eigvalsh(fits.covariances[:-1]) > 0).all()
    assert np.isnan(fits.covariances[-1]).all()
    half = jaxfit.fit(model, [read_image(face.image)[::2, ::2] for face in heads[:3]], [box / 2 for box in boxes[:3]])
    assert half.covariances is not None
    ratio = np.median(fits.covariances[:3, :, 0, 0] / half.covariances[:, :, 0, 0])
    assert 2.5 < ratio < 6  # deviations are in the pixels of the picture
    plain = jaxfit.fit(replace(model, confidence=None, uncertainty=None), pictures, boxes)
    assert plain.confidence is plain.covariances is plain.visible is None
    np.testing.assert_array_equal(plain.ok, fits.fitted)
    np.testing.assert_allclose(plain.landmarks, fits.landmarks, atol=1e-3)


def test_samples_tell_what_fits_tell(model, heads) -> None:
    samples = sample_fits(model, heads, seed=3)
    assert set(samples.starts) == {*NO_FACES, DETECTED, LOST, "upside down"} - ({ELSEWHERE} - set(samples.starts))
    assert not samples.good[samples.starts == PATTERN].any()
    for passes in (1, 2):
        once = samples.passes == passes
        assert once.sum() == len(once) / 2
        assert auroc(samples.confidence[once], samples.good[once]) > 0.85
    again = sample_fits(model, heads[5:], seed=3)
    some = samples.faces >= 5
    np.testing.assert_array_equal(again.starts, samples.starts[some])
    np.testing.assert_allclose(again.errors, samples.errors[some], rtol=1e-3)
    unread = replace(heads[0], image=Path("nowhere.png"))
    mute = sample_fits(replace(model, confidence=None), [*heads[:2], unread])
    assert np.isnan(mute.confidence).all()
    assert {*mute.faces} == {0, 1}
    assert [problem.partition(":")[0] for problem in mute.problems] == ["nowhere.png"]


def test_saving_changes_nothing(model, tmp_path: Path) -> None:
    jaxfit.save(model, tmp_path / "taught.safetensors")
    copy = jaxfit.load(tmp_path / "taught.safetensors")
    networks = [(each.confidence, each.uncertainty) for each in (copy, model)]
    pairs = zip(*map(jax.tree.leaves, networks), strict=True)
    assert all(np.array_equal(one, other) for one, other in pairs)
    jaxfit.save(replace(model, confidence=None, uncertainty=None), tmp_path / "plain.safetensors")
    plain = jaxfit.load(tmp_path / "plain.safetensors")
    assert plain.confidence is plain.uncertainty is None


CONFIDENCE = [f"confidence.{part}" for part in ("seen", "moved", "biases", "output", "offset")]
UNCERTAINTY = [f"uncertainty.{part}" for part in ("seen", "shape", "axes", "own", "output", "offset")]


@pytest.mark.parametrize("name", [*CONFIDENCE, *UNCERTAINTY])
@pytest.mark.parametrize("damage", ["longer", "missing", "nan"])
def test_damaged_files_are_refused(model, tmp_path: Path, name: str, damage: str) -> None:
    path = tmp_path / "taught.safetensors"
    jaxfit.save(model, path)
    data = path.read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
    tensors = unpack(data)
    if damage == "longer":
        tensors[name] = np.concatenate([np.atleast_1d(tensors[name])] * 2)
    elif damage == "nan":
        tensors[name] = np.full_like(tensors[name], np.nan)
    else:
        del tensors[name]
    path.write_bytes(pack(tensors, header))
    with pytest.raises(ModelError, match="damaged"):
        jaxfit.load(path)


def test_what_is_learned_is_as_likely_as_it_says() -> None:
    """Fits whose chance to be good is known: of two clues that count, one in the features and one in the moves."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(40, 6)))[0]
    projection = Projection(jnp.asarray(rng.normal(size=40), jnp.float32), jnp.asarray(axes, jnp.float32))

    spread = rng.uniform(0.5, 2, 14)

    def fits(count: int):
        clues = rng.normal(size=(count, 6 + 8)) * spread + 1
        chance = 1 / (1 + np.exp(-2 * (clues[:, 0] - clues[:, 9]).clip(-2, 2)))
        return clues.astype(np.float32), rng.random(count) < chance

    seen = [trusting._Samples(*fits(2000), np.full(2000, DETECTED)) for _ in range(3)]
    confidence = trusting._learned(seen, projection, 0)
    clues, good = fits(20_000)
    features = np.asarray(projection.mean) + clues[:, :6] @ axes.T
    told = np.asarray(jax.vmap(confidence)(Clues(jnp.asarray(features, jnp.float32), jnp.asarray(clues[:, 6:]))))
    assert calibration_error(told, good) < 0.03
    best = auroc((clues[:, 0] - clues[:, 9]).clip(-2, 2), good)
    assert best - 0.03 < auroc(told, good) <= best + 0.005


def test_platt_scaling_undoes_a_wrong_scale() -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, 50_000)
    happened = rng.random(len(logits)) < 1 / (1 + np.exp(-logits))
    np.testing.assert_allclose(trusting._platt(3 * logits - 1, happened), [1 / 3, 1 / 3], atol=0.02)


def test_boxes_are_what_they_are_called() -> None:
    rng = np.random.default_rng(0)
    boxes = {start: [box_of_start(start, SQUARE, PICTURE, rng) for _ in range(300)] for start in (DETECTED, LOST, PART)}
    far = [box_of_start(ELSEWHERE, SQUARE, PICTURE, rng) for _ in range(300)]
    assert all(overlap(box, SQUARE) < 0.15 for box in far)
    centres = np.stack([box[:2] + box[2:] / 2 for box in far])
    assert ((centres >= 0) & (centres <= PICTURE[::-1])).all()
    assert all((box[:2] >= SQUARE[:2]).all() and (box[:2] + box[2:] <= SQUARE[:2] + 80).all() for box in boxes[PART])
    assert max(box[2] for box in boxes[PART]) <= 0.4 * 80
    factors = np.array([box[2] / 80 for box in boxes[LOST]])
    assert 0.5 <= factors.min() < 0.6
    assert 1.8 < factors.max() <= 2
    offsets = np.array([box[:2] + box[2:] / 2 - [100, 90] for box in boxes[LOST]]) / 80
    assert 0.45 < np.abs(offsets).max() <= 0.5
    spread = np.array([box[:2] + box[2:] / 2 - [100, 90] for box in boxes[DETECTED]]).std() / 80
    assert 0.06 < spread < 0.15
    assert box_of_start(ELSEWHERE, np.array([-20.0, -20, 60, 60]), (20, 20), rng) is None


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """By counting the pixels of a fine grid."""
    y, x = np.mgrid[-200:600:400j, -200:600:400j]
    in_a, in_b = ((x >= c[0]) & (x < c[0] + c[2]) & (y >= c[1]) & (y < c[1] + c[3]) for c in (a, b))
    return (in_a & in_b).sum() / max((in_a | in_b).sum(), 1) - 0.01  # the grid is coarse for small boxes


def test_a_model_says_how_it_was_trained(model) -> None:
    method, options = trusting.training_of(model)
    assert method == "sdm"
    told = replace(OPTIONS, descriptor=model.cascade.descriptor)
    assert options == replace(told, frame=model.cascade.frame)
    with pytest.raises(InputError, match="says how it was trained"):
        trusting.training_of(replace(model, training={}))


def test_the_head_model_that_a_model_was_trained_with_is_asked_for(model) -> None:
    solid = replace(model, training=model.training | {"method": "regression3d", "head": "ict-facekit"})
    assert trusting.training_of(solid)[1].head_model == "ict-facekit"
    own = replace(solid, training=solid.training | {"head": "mine.safetensors"})
    for given in (None, "ict-facekit", "other.safetensors"):
        with pytest.raises(InputError, match="expected the 3D head model mine"):
            trusting.training_of(own, given)
    assert trusting.training_of(own, "a/mine.safetensors")[1].head_model == "a/mine.safetensors"


def test_incomplete_faces_take_part_in_fine_tuning_alone(model, heads, monkeypatch) -> None:
    learned, tested = [], []

    class Enough(Exception):
        pass

    def tuned(of, like, faces, **_):
        learned.extend(faces)
        return of

    def drawn(of, faces, *_):
        tested.extend(faces)
        raise Enough

    monkeypatch.setattr(trusting, "train", lambda *_, **__: SimpleNamespace(model=model))
    monkeypatch.setattr(trusting, "retuned", tuned)
    monkeypatch.setattr(trusting, "draw_starts", drawn)
    partial = [replace(face, present=np.arange(21) > 3) for face in heads[::2]]
    with pytest.raises(Enough):
        learn_confidence(model, [*heads[1::2], *partial], folds=2)
    assert {face.complete for face in learned} == {True, False}
    assert not {face.subject for face in learned} & {face.subject for face in tested}


def test_what_cannot_be_learned_from_is_refused(model, heads) -> None:
    with pytest.raises(InputError, match="from 2 to the number of subjects"):
        learn_confidence(model, heads, folds=1)
    with pytest.raises(InputError, match="landmarks, as the model's"):
        sample_fits(model, [replace(heads[0], landmarks=np.zeros((5, 2)))])
    with pytest.raises(InputError, match="that can be read; got none"):
        sample_fits(model, [replace(heads[0], image=Path("nowhere.png"))])
    same = trusting._Samples(np.zeros((4, 9)), np.ones(4, bool), np.full(4, DETECTED))
    with pytest.raises(InputError, match="good and bad fits"):
        trusting._learned([same, same], Projection(jnp.zeros(3), jnp.eye(3)), 0)


def test_confidences_and_samples_are_what_they_seem(model) -> None:
    assert isinstance(model.confidence, Confidence)
    samples = SampledFits(
        np.array([0.079, 0.081, np.inf]), np.array([DETECTED] * 3), np.arange(3), np.ones(3), np.zeros(3)
    )
    assert samples.good.tolist() == [True, False, False]
