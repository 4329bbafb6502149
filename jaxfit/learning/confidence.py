"""Teaching a model how far its fits can be trusted: fits from good and bad starts, of faces and of what is none.

On the faces that a cascade was trained on its fits are too good to learn from. So cascades that were trained alike, on
some of the people each, fit the others, and the confidence learns from those fits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy
from jax import lax, random
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.cascade.confidence import Clues, Confidence
from jaxfit.cascade.fit import find_clues
from jaxfit.cascade.regression import Projection, principal_axes
from jaxfit.cascade.starts import Starts
from jaxfit.data.pictures import GreyPictures, Read
from jaxfit.errors import InputError
from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.heads.model import DEFAULT_HEAD_MODEL, bundled_head_models
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.draw_starts import DETECTED, DrawnStarts, draw_starts
from jaxfit.learning.finetune import retuned
from jaxfit.learning.methods import METHODS, Options
from jaxfit.learning.prepare import part_of
from jaxfit.learning.train import train
from jaxfit.learning.uncertainty import Axes, Sighted, learned_uncertainty, sight
from jaxfit.models.digests import union
from jaxfit.models.model import Model
from jaxfit.modes import computing, mixing_types
from jaxfit.processes import require_alone
from jaxfit.types import Progress, silent

_BATCH = 64
_PASSES = (1, 2)  # of the cascade: the second moves less, however good it is
_PCA_SAMPLES = 3072
_MOST_AXES = 128
_VARIANCE = 0.9
_HIDDEN = 32
# Of the network's training.
_EPOCHS, _AT_ONCE, _RATE, _DECAY = 30, 256, 2e-3, 0.3


@dataclass(frozen=True)
class SampledFits:
    """N fits of labelled faces, and of what is no face.

    Attributes:
        errors: (N,) NMED (`default_normaliser`); ``inf`` where there was no face at all.
        starts: (N,) how each began: in a box ``"detected"``, as a detector might have drawn it, ``"lost"``, off by up
            to half a face and a factor of 2, ``"elsewhere"`` in the picture, around a ``"part"`` of the face, or as
            detected but ``"upside down"``, or on a ``"pattern"``.
        faces: (N,) the number of each fit's face among those given.
        passes: (N,) how often the cascade was run: each start is fitted in one pass, and again in two.
        confidence: (N,) what the model says of each fit; NaN if it has no confidence.
        problems: which pictures could not be read and why, a sentence each.
    """

    errors: np.ndarray
    starts: np.ndarray
    faces: np.ndarray
    passes: np.ndarray
    confidence: np.ndarray
    problems: tuple[str, ...] = ()

    @property
    def good(self) -> np.ndarray:
        """(N,) bool: which fits are good."""
        return self.errors < LIMIT


@computing
def learn_confidence(
    model: Model,
    faces: Sequence[FaceRecord],
    *,
    subjects: Sequence[str] | None = None,
    folds: int = 3,
    seed: int = 0,
    head_model: str | Path | None = None,
    read: Read | None = None,
    progress: Progress = silent,
) -> Model:
    """The model with a confidence: the probability that a fit is good, its NMED (`default_normaliser`) below 0.08; and
    with an uncertainty: how far each landmark may be off, and whether it can be seen.

    Trains ``folds`` models as ``model`` says that it was trained, and fine-tuned, each without the people of its fold,
    whom it then fits: that takes about as many times longer than training did.

    Args:
        model: what to teach; its confidence, if it has one, is replaced.
        faces: labelled faces, best those that the model was trained on; those with missing landmarks take part in
            fine-tuning and in the uncertainty alone.
        subjects: who is seen on each of the faces, if not as they say themselves.
        folds: how many models are trained.
        seed: of folds, starts and the network.
        head_model: the 3D head model that the model was trained with: needed where it is not a bundled one, as model
            files do not say where it lies.
        read: gets a picture's path and returns it grey, uint8 (H, W); the default remembers them.
        progress: called with a stage's name, what is done and what there is to do.

    Raises:
        InputError: labels of another number of landmarks, no eye corners, fewer people than folds, fits that are all
            good or all bad, a model that does not say how it was trained, another head model, or several processes.
        ModelError: no such head model.
    """
    require_alone("learning a confidence")
    read = read or GreyPictures()
    method, options = training_of(model, head_model)
    people = [face.subject for face in faces] if subjects is None else list(subjects)
    parts = split_by_subject(people, folds, seed)
    projection: Projection | None = None
    samples: list[_Samples] = []
    axes: Axes | None = None
    sighted: list[Sighted] = []
    pictures = model.learned
    for fold in range(folds):
        report = part_of(progress, f"fold {fold + 1}/{folds}")
        learned = [face for face, part in zip(faces, parts, strict=True) if part != fold]
        tested = [face for face, part in zip(faces, parts, strict=True) if part == fold]
        trained = train(learned, model.scheme, method=method, options=options, progress=report, read=read).model
        trained = retuned(
            trained, model, learned, head_model=head_model or DEFAULT_HEAD_MODEL, progress=report, read=read
        )
        pictures = union(pictures, trained.learned)
        drawn, _ = draw_starts(
            trained, tested, seed, read, report
        )  # whoever trained the model knows what cannot be read
        # All folds see with the same descriptors: axes of the first will do for all.
        projection = projection or _axes(trained, drawn, seed)
        sampled, clues = _fitted(trained, drawn, _Project(projection), report)
        samples.append(_Samples(clues, sampled.good, sampled.starts))
        of_fold, axes = sight(trained, tested, axes, seed, read, report)
        sighted.append(of_fold)
    progress("learning how likely fits are good", 0, 1)
    confidence = _learned(samples, projection, seed) if projection else None
    progress("learning how likely fits are good", 1, 1)
    progress("learning how far landmarks may be off", 0, 1)
    uncertainty = learned_uncertainty(sighted, axes, seed) if axes else None
    progress("learning how far landmarks may be off", 1, 1)
    return replace(model, confidence=confidence, uncertainty=uncertainty, learned=pictures)


@computing
def sample_fits(
    model: Model,
    faces: Sequence[FaceRecord],
    *,
    seed: int = 0,
    read: Read | None = None,
    progress: Progress = silent,
) -> SampledFits:
    """Fits of labelled faces from good and bad starts, and of what is no face; what the model says of them, and how
    good they are.

    Args:
        model: a model.
        faces: labelled faces; those with missing landmarks are left out, and those whose pictures cannot be read,
            which are reported.
        seed: of the starts; a face has the same whatever other faces come with it.
        read: as in `learn_confidence`, like the next.
        progress: called with a stage's name, what is done and what there is to do.

    Raises:
        InputError: labels of another number of landmarks, or none that can be used.
    """
    confidence = model.confidence
    drawn, problems = draw_starts(model, faces, seed, read or GreyPictures(), progress)
    sampled, said = _fitted(model, drawn, _Nothing() if confidence is None else confidence, progress)
    return replace(sampled, confidence=said.astype(np.float64), problems=problems)


def training_of(model: Model, head_model: str | Path | None = None) -> tuple[str, Options]:
    """The method and the options that a model was trained with, but for the detectors.

    Args:
        model: the model.
        head_model: the 3D head model that it was trained with, if it was: a bundled one's name, or a file; None for the
            bundled one that it names.

    Raises:
        InputError: it does not say how, or it was trained with another head model.
    """
    settings: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in model.training.items()
    }
    if settings.get("method") not in METHODS or "windows" not in settings:
        raise InputError(f"expected a model that says how it was trained, as jaxfit.train makes; got {model.training}")
    known = {name: settings[name] for name in Options().flat() if name in settings}
    if "head" in settings:
        given = Path(head_model or settings["head"]).name
        if given != settings["head"] or (head_model is None and given not in bundled_head_models()):
            got = "none was given" if head_model is None else f"got {head_model}"
            raise InputError(f"expected the 3D head model {settings['head']}, which the model was trained with; {got}")
        known["head_model"] = str(head_model or given)
    descriptor, frame = model.cascade.descriptor, model.cascade.frame
    known |= {"starts": model.starts, "detectors": False, "descriptor": descriptor, "frame": frame}
    return settings["method"], Options().but(**known)


class _Samples(NamedTuple):
    """The clues (N, …) of N fits, reduced to principal components and moves, which are good, and how each began."""

    clues: np.ndarray
    good: np.ndarray
    starts: np.ndarray


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Project:
    """Keeps clues as principal components of the features and the moves."""

    projection: Projection

    def __call__(self, clues: Clues) -> Array:
        components = (clues.features - self.projection.mean) @ self.projection.axes
        return jnp.concatenate([components, clues.moves])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Nothing:
    """Of models without a confidence."""

    def __call__(self, clues: Clues) -> Array:
        return jnp.full((), jnp.nan, jnp.float32)


class _Features:
    """Keeps the features alone; equal to all others of its kind, and static."""

    def __call__(self, clues: Clues) -> Array:
        return clues.features


jax.tree_util.register_static(_Features)


@partial(jax.jit, static_argnames="passes")
def _tried(
    model: tuple[Any, Any], crops: Array, turns: Array, passes: int
) -> tuple[Float[Array, "faces landmarks 2"], Array]:
    cascade, of_clues = model
    landmarks, clues = find_clues(cascade, crops, turns, passes)
    return landmarks, jax.vmap(of_clues)(clues)


def _fitted(
    model: Model, drawn: DrawnStarts, of_clues: Any, progress: Progress, often: Sequence[int] = _PASSES
) -> tuple[SampledFits, np.ndarray]:
    """Fits of what was drawn, in so many passes each, and what ``of_clues`` makes of each fit's clues; models that are
    made for several starts fit from one and from several."""
    kinds = [Starts()] if model.starts.count == 1 else [Starts(), model.starts]
    turns = [starts.rotations for starts in kinds]
    ways = [(turn, passes) for turn in turns for passes in often]
    count = len(drawn.crops)
    landmarks, kept = [], []
    for way in ways:
        for first in range(0, count, _BATCH):
            progress("fitting", first, count)
            rows = np.minimum(np.arange(first, first + _BATCH), count - 1)
            left = min(_BATCH, count - first)
            found = _tried((model.cascade, of_clues), drawn.crops[rows], *way)
            landmarks.append(np.asarray(found[0])[:left])
            kept.append(np.asarray(found[1])[:left])
    progress("fitting", count, count)
    truth, starts, faces = (np.concatenate([part] * len(ways)) for part in drawn[1:])
    # Where there is no truth nothing can be measured: no face.
    measured = nmed(np.concatenate(landmarks), truth, model.scheme)
    errors = np.where(np.isnan(measured), np.inf, measured)
    passes = np.repeat([passes for _, passes in ways], count)
    return SampledFits(errors, starts, faces, passes, np.full(len(errors), np.nan)), np.concatenate(kept)


def _axes(model: Model, drawn: DrawnStarts, seed: int) -> Projection:
    """Principal axes of the descriptors of some fits."""
    chosen = np.random.default_rng(seed).permutation(len(drawn.crops))[:_PCA_SAMPLES]
    some = DrawnStarts(*(part[chosen] for part in drawn))
    _, features = _fitted(model, some, _Features(), silent, _PASSES[:1])
    found = principal_axes(jnp.asarray(features[:_PCA_SAMPLES]), _VARIANCE)
    return Projection(found.mean, found.axes[:, :_MOST_AXES])


class _Network(NamedTuple):
    """A network of one hidden layer."""

    weights: Float[Array, "inputs hidden"]
    biases: Float[Array, "hidden"]
    output: Float[Array, "hidden"]
    offset: Float[Array, ""]

    def __call__(self, inputs: Float[Array, "*samples inputs"]) -> Float[Array, "*samples"]:
        """Logits."""
        return jnp.tanh(inputs @ self.weights + self.biases) @ self.output + self.offset


def _learned(samples: Sequence[_Samples], projection: Projection, seed: int) -> Confidence:
    """The confidence learned from the fits of several folds: learned from all, and calibrated on those of detected
    faces in each, by a network that learned from the others."""
    folds = np.concatenate([np.full(len(fold.good), number) for number, fold in enumerate(samples)])
    clues, good, starts = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    finite = np.isfinite(clues).all(1)  # what diverges is no fit
    clues, good, starts, folds = clues[finite], good[finite], starts[finite], folds[finite]
    detected = starts == DETECTED
    if good[detected].all() or not good[detected].any():
        raise InputError(
            "expected good and bad fits to learn from: with errors (NMED) below and above "
            f"{LIMIT}; of {detected.sum()} fits of faces {good[detected].sum()} are good; give more faces"
        )
    mean, deviation = clues.mean(0), clues.std(0) + 1e-6
    inputs = ((clues - mean) / deviation).astype(np.float32)
    logits = np.zeros(len(good))
    for fold in range(len(samples)):
        held_out = folds == fold
        logits[held_out] = _trained(inputs[~held_out], good[~held_out], seed)(jnp.asarray(inputs[held_out]))
    # What confidences are mostly asked for: among all fits, the easy ones would outvote the doubtful.
    slope, shift = _platt(logits[detected], good[detected])
    network = _trained(inputs, good, seed)
    axes = projection.axes.shape[1]
    weights = np.asarray(network.weights, np.float64) / deviation[:, None]
    # Rounded to what model files store, so that saving changes nothing.
    whole = (np.asarray(projection.axes, np.float64) @ weights[:axes]).astype(np.float16).astype(np.float64)
    centred = np.asarray(projection.mean) @ whole + mean[:axes] @ weights[:axes] + mean[axes:] @ weights[axes:]
    return Confidence(
        seen=jnp.asarray(whole, jnp.float32),
        moved=jnp.asarray(weights[axes:], jnp.float32),
        biases=jnp.asarray(np.asarray(network.biases) - centred, jnp.float32),
        output=jnp.asarray(slope * np.asarray(network.output), jnp.float32),
        offset=jnp.asarray(slope * np.asarray(network.offset) + shift, jnp.float32),
    )


@partial(jax.jit, static_argnames="seed")
def _trained(inputs: Float[Array, "samples inputs"], good: Array, seed: int) -> _Network:
    """A network that learned to tell which samples are good."""
    import optax  # not before: few learn, and all would wait for it

    count = len(inputs)
    at_once = min(_AT_ONCE, count)
    steps = _EPOCHS * (count // at_once)
    first, order = random.split(random.key(seed))
    weights = random.normal(first, (inputs.shape[1], _HIDDEN), inputs.dtype) / np.sqrt(inputs.shape[1]).astype(
        np.float32
    )
    network = _Network(weights, *(jnp.zeros(shape, inputs.dtype) for shape in (_HIDDEN, _HIDDEN, ())))
    optimiser = optax.adamw(optax.cosine_decay_schedule(_RATE, steps), weight_decay=_DECAY)

    def loss(network: _Network, rows: Array) -> Array:
        return optax.sigmoid_binary_cross_entropy(network(inputs[rows]), good[rows].astype(jnp.float32)).mean()

    def step(state: tuple[_Network, Any], rows: Array) -> tuple[tuple[_Network, Any], None]:
        network, moments = state
        slopes = jax.grad(loss)(network, rows)
        with mixing_types():
            updates, moments = optimiser.update(slopes, moments, network)
        return (optax.apply_updates(network, updates), moments), None

    def epoch(state: tuple[_Network, Any], key: Array) -> tuple[tuple[_Network, Any], None]:
        rows = random.permutation(key, count)[: count // at_once * at_once]
        return lax.scan(step, state, rows.reshape(-1, at_once))

    (network, _), _ = lax.scan(epoch, (network, optimiser.init(network)), random.split(order, _EPOCHS))
    return network


def _platt(logits: np.ndarray, good: np.ndarray) -> tuple[float, float]:
    """The slope and shift with which logits (N,) give the most likely probabilities (Platt)."""

    def loss(parts: np.ndarray) -> float:
        scaled = parts[0] * logits + parts[1]
        return float(np.mean(np.logaddexp(0, scaled) - good * scaled))

    slope, shift = scipy.optimize.minimize(loss, np.array([1.0, 0.0])).x
    return float(slope), float(shift)
