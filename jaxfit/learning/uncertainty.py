"""Teaching a model how far its landmarks may be off, and which can be seen: from fits of people it did not learn from.

Errors come from labels. What is hidden is labelled in some data sets; besides, parts of other pictures are laid over
half of the crops, which hide what lies below them.
"""

import zlib
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy
from jax import lax, random, vmap
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.cascade.confidence import Clues
from jaxfit.cascade.fit import find_clues
from jaxfit.cascade.regression import Projection, principal_axes
from jaxfit.cascade.uncertainty import FREEDOM, OUTPUTS, Uncertainty, factors_of, region_radius, shape_of, size_of
from jaxfit.data.boxes import bounding_square
from jaxfit.data.crops import Crops, cut
from jaxfit.data.pictures import Read, to_grey
from jaxfit.errors import ImageError
from jaxfit.image.disturb import covered, draw_cover
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.draw_starts import DETECTED, box_of_start
from jaxfit.models.model import SQUARE, Model
from jaxfit.modes import mixing_types
from jaxfit.schemes.scheme import mirror_order, mirrored
from jaxfit.types import Progress

_BATCH = 64
_DRAWS = 2  # crops of each face, from other boxes and with other covers
_COVERED = 0.5  # share of the crops that something covers
_SAMPLES = 2048  # that principal axes are learned from
_AXES, _OWN_AXES = 128, 24  # of all descriptors of a face, and of a landmark's own
_VARIANCE = 0.98
_HIDDEN = 32
_EPOCHS, _AT_ONCE, _RATE, _DECAY = 24, 256, 2e-3, 0.1  # of the network's training
_LEVELS = (0.5, 0.9, 0.95)  # shares of the true landmarks that regions shall hold


class Sighted(NamedTuple):
    """N fits of faces, landmark by landmark.

    Attributes:
        clues: (N, K) what was seen and how the fits moved, reduced, and the shapes.
        own: (N, L, k) what each landmark has seen itself, reduced.
        errors: (N, L, 2) from the true landmarks to the fitted ones, in sizes of the face; NaN where unknown.
        seen: (N, L) 1 for landmarks that can be seen, 0 for hidden ones, NaN where unknown.
    """

    clues: np.ndarray
    own: np.ndarray
    errors: np.ndarray
    seen: np.ndarray


class Axes(NamedTuple):
    """Principal axes that clues are reduced to: of all descriptors of a face together, and of one landmark's."""

    whole: Projection
    own: Projection


class DrawnFaces(NamedTuple):
    """Crops (N, H, H) of faces, the true landmarks (N, L, 2) in them, NaN where unknown, and which can be seen."""

    crops: np.ndarray
    truth: np.ndarray
    seen: np.ndarray


def sight(
    model: Model, faces: Sequence[FaceRecord], axes: Axes | None, seed: int, read: Read, progress: Progress
) -> tuple[Sighted, Axes]:
    """The fits of a model of faces that it did not learn from, from boxes like a detector's, and the axes that their
    clues are reduced to: those given, or their own.

    Args:
        model: whose cascade fits.
        faces: labelled faces; some landmarks may be missing.
        axes: of fits before; None: they are learned from these.
        seed: of boxes, mirror images and covers.
        read: gets a picture's path and returns it grey.
        progress: called with the stage's name, what is done and what there is to do.
    """
    draws = [draw_faces(model, faces, seed + number, read, progress) for number in range(_DRAWS)]
    drawn = DrawnFaces(*(np.concatenate(part) for part in zip(*draws, strict=True)))
    axes = axes or _axes(model, drawn, seed)
    parts = []
    for first in range(0, len(drawn.crops), _BATCH):
        progress("fitting", first, len(drawn.crops))
        rows = np.minimum(np.arange(first, first + _BATCH), len(drawn.crops) - 1)
        found = _fitted(model.cascade, drawn.crops[rows], jnp.zeros(1), axes)
        parts.append([np.asarray(part)[: len(drawn.crops) - first] for part in found])
    progress("fitting", len(drawn.crops), len(drawn.crops))
    landmarks, clues, own, sizes = (np.concatenate(part) for part in zip(*parts, strict=True))
    errors = (landmarks - drawn.truth) / sizes[:, None, None]
    finite = np.isfinite(landmarks).all((1, 2)) & np.isfinite(clues).all(1)
    return Sighted(*(part[finite] for part in (clues, own, errors, drawn.seen))), axes


def draw_faces(model: Model, faces: Sequence[FaceRecord], seed: int, read: Read, progress: Progress) -> DrawnFaces:
    """The faces' crops, half of them mirrored, half of them partly covered."""
    placement, scheme = model.placement(SQUARE), model.scheme
    crop = Crops.empty(1, model.cascade.frame)
    crops, truths, seen = [], [], []
    for number, face in enumerate(faces):
        progress("drawing faces", number, len(faces))
        if not np.isfinite(face.landmarks).all(1).any():
            continue
        try:
            picture = to_grey(read(face.image))
        except ImageError:
            continue  # whoever trained the model knows
        rng = np.random.default_rng([seed, zlib.crc32(face.face.encode())])
        points, known = face.landmarks, face.known
        visible = np.where(known & face.visible, 1.0, np.where(face.visible, np.nan, 0.0))
        if scheme.mirror is not None and rng.random() < 0.5:
            order = list(mirror_order(scheme))
            picture, points = picture[:, ::-1], mirrored(points, picture.shape[1], scheme)
            known, visible = known[order], visible[order]
        box = box_of_start(DETECTED, bounding_square(points), picture.shape, rng)
        assert box is not None  # there always is one like a detector's
        cut(picture, *placement.face_in(box), crop, 0)
        crops.append(crop.pixels[0].copy())
        truths.append(np.where(known[:, None], crop.from_images(points[None])[0], np.nan))
        seen.append(visible)
    progress("drawing faces", len(faces), len(faces))
    truth = np.stack(truths)
    labels = _like_neighbours(np.stack(seen), model.mean_face)
    pixels, hidden = _with_covers(random.key(seed), np.stack(crops), np.nan_to_num(truth, nan=-1e4))
    return DrawnFaces(pixels, truth, np.where(hidden & np.isfinite(truth).all(2), 0.0, labels))


def _like_neighbours(seen: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Labels (N, L) in which landmarks of which nothing is known are like the nearest ones on the mean face (L, 2) of
    which something is: the outline's far side is hidden where the eye before it is."""
    apart = np.linalg.norm(mean[:, None] - mean, axis=2)
    nearest = np.where(np.isfinite(seen)[:, None], apart, np.inf).argmin(2)
    return np.where(np.isfinite(seen), seen, np.take_along_axis(seen, nearest, 1))


def _with_covers(key: Array, crops: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Crops (N, H, H) with parts of each other over half of them, and which of the points (N, L, 2) these hide."""
    pixels: list[np.ndarray] = []
    hidden: list[np.ndarray] = []
    for first in range(0, len(crops), _BATCH):
        rows = np.minimum(np.arange(first, first + _BATCH), len(crops) - 1)
        keys = random.split(random.fold_in(key, first), _BATCH)
        found = _cover(keys, crops[rows], crops[(rows + _BATCH // 2) % len(crops)], points[rows].astype(np.float32))
        for parts, part in zip((pixels, hidden), found, strict=True):
            parts.append(np.asarray(part)[: len(crops) - first])
    return np.concatenate(pixels), np.concatenate(hidden)


@jax.jit
def _cover(keys: Array, crops: Array, others: Array, points: Array) -> tuple[Array, Array]:
    def of_face(key: Array, crop: Array, other: Array, points: Array) -> tuple[Array, Array]:
        cover = draw_cover(key, len(crop), _COVERED)
        picture = covered(crop.astype(jnp.float32), other.astype(jnp.float32), cover)
        return picture.astype(jnp.uint8), cover.hides(points)

    return vmap(of_face)(keys, crops, others, points)


@jax.jit
def _fitted(cascade: Any, crops: Array, rotations: Array, axes: Axes) -> tuple[Array, Array, Array, Array]:
    """The landmarks of crops in their pixels, the reduced clues and own descriptors of them, and the faces' sizes."""
    landmarks, clues = find_clues(cascade, crops, rotations)
    shapes = vmap(shape_of)(landmarks).reshape(len(landmarks), -1)
    whole = jnp.concatenate([_reduced(clues.features, axes.whole), clues.moves, shapes], 1)
    own = _reduced(clues.features.reshape(*landmarks.shape[:2], -1), axes.own)
    return landmarks, whole, own, vmap(size_of)(landmarks)


def _reduced(features: Array, axes: Projection) -> Array:
    return (features - axes.mean) @ axes.axes


def _axes(model: Model, drawn: DrawnFaces, seed: int) -> Axes:
    """Principal axes of the descriptors of some fits."""
    chosen = np.random.default_rng(seed).permutation(len(drawn.crops))[:_SAMPLES]
    parts: list[Clues] = []
    for first in range(0, len(chosen), _BATCH):
        rows = np.resize(chosen[first : first + _BATCH], _BATCH)
        parts.append(find_clues(model.cascade, jnp.asarray(drawn.crops[rows]), jnp.zeros(1))[1])
    features = jnp.concatenate([part.features for part in parts])[: len(chosen)]
    each = features.reshape(len(features) * model.scheme.count, -1)
    some = np.random.default_rng(seed).permutation(len(each))[: 8 * _SAMPLES]
    whole, own = principal_axes(features, _VARIANCE), principal_axes(each[some], _VARIANCE)
    return Axes(Projection(whole.mean, whole.axes[:, :_AXES]), Projection(own.mean, own.axes[:, :_OWN_AXES]))


class _Network(NamedTuple):
    """What is learned; inputs are whitened."""

    weights: Float[Array, "inputs hidden"]
    biases: Float[Array, "hidden"]
    own: Float[Array, "landmarks 2 own 4"]
    output: Float[Array, "hidden landmarks 4"]
    offset: Float[Array, "landmarks 4"]

    def __call__(self, clues: Array, own: Array) -> Float[Array, "samples landmarks 4"]:
        units = jnp.tanh(clues @ self.weights + self.biases)
        each = jnp.einsum("nlpk,lpko->nlo", jnp.stack([own, own**2], 2), self.own)
        return each + jnp.einsum("nh,hlo->nlo", units, self.output) + self.offset


def learned_uncertainty(folds: Sequence[Sighted], axes: Axes, seed: int) -> Uncertainty:
    """The uncertainty learned from the fits of several folds: from all of them, and calibrated on those of each fold by
    a network that learned from the others: regions hold the share of landmarks that they claim.

    Args:
        folds: fits of people that the fold's model did not learn from.
        axes: that their clues were reduced to.
        seed: of the network.
    """
    number = np.concatenate([np.full(len(fold.clues), place) for place, fold in enumerate(folds)])
    clues, own, errors, seen = (np.concatenate(part) for part in zip(*folds, strict=True))
    mean, deviation = clues.mean(0), clues.std(0) + 1e-6
    own_mean, own_deviation = own.mean((0, 1)), own.std((0, 1)) + 1e-6
    inputs = ((clues - mean) / deviation).astype(np.float32), ((own - own_mean) / own_deviation).astype(np.float32)
    truth = errors.astype(np.float32), seen.astype(np.float32)
    raw = np.zeros((*seen.shape, OUTPUTS), np.float32)
    for fold in range(len(folds)):
        out = number == fold
        network = _trained(tuple(part[~out] for part in inputs), tuple(part[~out] for part in truth), seed)
        raw[out] = network(*(jnp.asarray(part[out]) for part in inputs))
    scale, (slope, shift) = _region_scale(raw, errors), _platt(raw[..., 3], seen)
    network = _trained(inputs, truth, seed)
    slopes = np.array([1, 1, 1, slope])
    offset = np.asarray(network.offset, np.float64) * slopes + [np.log(scale), np.log(scale), 0, shift]
    # Whitening and axes are folded into the weights, rounded to what model files store.
    weights = np.asarray(network.weights, np.float64) / deviation[:, None]
    kept = axes.whole.axes.shape[1]
    whole = (np.asarray(axes.whole.axes, np.float64) @ weights[:kept]).astype(np.float16).astype(np.float64)
    centred = np.asarray(axes.whole.mean) @ whole + mean[:kept] @ weights[:kept] + mean[kept:] @ weights[kept:]
    moves = clues.shape[1] - kept - 2 * seen.shape[1]
    of_moves, of_shape = np.split(weights[kept:], [moves])
    each = (np.asarray(axes.own.axes, np.float64) / own_deviation).astype(np.float16).astype(np.float64)
    centre = np.asarray(axes.own.mean) @ each + own_mean / own_deviation
    return Uncertainty(
        seen=jnp.asarray(whole, jnp.float32),
        moved=jnp.asarray(of_moves, jnp.float32),
        shape=jnp.asarray(of_shape.reshape(seen.shape[1], 2, -1), jnp.float32),
        biases=jnp.asarray(np.asarray(network.biases) - centred, jnp.float32),
        axes=jnp.asarray(each, jnp.float32),
        centre=jnp.asarray(centre, jnp.float32),
        own=jnp.asarray(np.asarray(network.own) * slopes, jnp.float32),
        output=jnp.asarray(np.asarray(network.output) * slopes, jnp.float32),
        offset=jnp.asarray(offset, jnp.float32),
    )


def standardised(raw: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """(...) lengths of errors (..., 2) in standard deviations of the covariances that raw outputs (..., 4) mean."""
    return np.asarray(_lengths(jnp.asarray(raw), jnp.asarray(errors, jnp.float32)))


@jax.jit
def _lengths(raw: Array, errors: Array) -> Array:
    return jnp.sqrt((FREEDOM - 2) / FREEDOM * jnp.sum(_whitened(raw, errors) ** 2, -1))


def _whitened(raw: Array, errors: Array) -> Array:
    """Errors (..., 2) in units of the Cholesky factors."""
    factors = factors_of(raw)
    first = errors[..., 0] / factors[..., 0, 0]
    return jnp.stack([first, (errors[..., 1] - factors[..., 1, 0] * first) / factors[..., 1, 1]], -1)


def _region_scale(raw: np.ndarray, errors: np.ndarray) -> float:
    """The factor on deviations with which regions hold the shares ``_LEVELS`` best."""
    lengths = standardised(raw, errors)
    lengths = lengths[np.isfinite(lengths)]
    radii = [region_radius(level) for level in _LEVELS]

    def worst(log_scale: float) -> float:
        held = [(lengths <= radius * np.exp(log_scale)).mean() for radius in radii]
        return float(np.abs(np.array(held) - _LEVELS).max())

    steps = np.linspace(-1, 1, 201)
    return float(np.exp(steps[np.argmin([worst(step) for step in steps])]))


def _platt(logits: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    """The slope and shift with which logits (N, L) give the most likely probabilities (Platt); as they are, where
    nothing, or nothing else, is known."""
    known = np.isfinite(seen)
    logits, seen = logits[known], seen[known]
    if not len(seen) or seen.min() == seen.max():
        return 1.0, 0.0

    def loss(parts: np.ndarray) -> float:
        scaled = parts[0] * logits + parts[1]
        return float(np.mean(np.logaddexp(0, scaled) - seen * scaled))

    slope, shift = scipy.optimize.minimize(loss, np.array([1.0, 0.0])).x
    return float(slope), float(shift)


def _trained(inputs: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray], seed: int) -> _Network:
    """A network that learned, by the likelihood of errors of heavy tails and of what is hidden."""
    return _optimised(tuple(map(jnp.asarray, inputs)), tuple(map(jnp.asarray, truth)), seed)


@partial(jax.jit, static_argnames="seed")
def _optimised(inputs: tuple[Array, Array], truth: tuple[Array, Array], seed: int) -> _Network:
    import optax  # not before: few learn, and all would wait for it

    (clues, own), (errors, seen) = inputs, truth
    count, landmarks = own.shape[:2]
    at_once = min(_AT_ONCE, count)
    steps = _EPOCHS * (count // at_once)
    first, order = random.split(random.key(seed))
    width = clues.shape[1]
    network = _Network(
        random.normal(first, (width, _HIDDEN), jnp.float32) / np.sqrt(width).astype(np.float32),
        jnp.zeros(_HIDDEN, jnp.float32),
        jnp.zeros((landmarks, 2, own.shape[2], OUTPUTS), jnp.float32),
        jnp.zeros((_HIDDEN, landmarks, OUTPUTS), jnp.float32),
        jnp.broadcast_to(jnp.array([-3.0, -3.0, 0.0, 2.0], jnp.float32), (landmarks, OUTPUTS)),
    )
    optimiser = optax.adamw(optax.cosine_decay_schedule(_RATE, steps), weight_decay=_DECAY)

    def loss(network: _Network, rows: Array) -> Array:
        raw = network(clues[rows], own[rows])
        known = jnp.isfinite(errors[rows]).all(-1)
        whitened = _whitened(raw, jnp.where(known[..., None], errors[rows], 0.0))
        tails = (FREEDOM + 2) / 2 * jnp.log1p(jnp.sum(whitened**2, -1) / FREEDOM)
        factors = factors_of(raw)
        sizes = jnp.log(factors[..., 0, 0]) + jnp.log(factors[..., 1, 1])
        told = jnp.isfinite(seen[rows])
        hidden = optax.sigmoid_binary_cross_entropy(raw[..., 3], jnp.where(told, seen[rows], 0.0))
        return _mean(tails + sizes, known) + _mean(hidden, told)

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


def _mean(values: Array, chosen: Array) -> Array:
    return jnp.sum(jnp.where(chosen, values, 0.0)) / jnp.maximum(chosen.sum(dtype=values.dtype), 1)
