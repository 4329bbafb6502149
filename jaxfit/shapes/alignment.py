"""A 3D Active Shape Model brought to 2D landmarks: the alternation of the thesis's Figure 7, and a joint refinement."""

from functools import partial
from typing import NamedTuple

import jax
from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfit.modes import mixing_types
from jaxfit.shapes.asm import ActiveShapeModel, Coefficients
from jaxfit.shapes.camera import Camera, align_shapes, rotation_angles, rotation_matrix, show
from jaxfit.types import Landmarks, Landmarks3D, Scalar

_EXACT = lax.Precision.HIGHEST
_MOST_ROUNDS = 30
# The error has stopped falling when a round lowers it by less than this share.
_AT_REST = 1e-3
_POSE = 6  # three angles, a scale, a place

Weights = Float[Array, "landmarks"]


class Alignment(NamedTuple):
    """A 3D shape model as it lies on 2D landmarks.

    Attributes:
        b: (M,) coefficients.
        camera: how the shape is seen; ``camera.ok`` says whether the landmarks determined it. If not, b is 0.
        error: sum of the distances between landmarks and projections, weighted, in pixels.
        rounds: of the alternation.
    """

    b: Coefficients
    camera: Camera
    error: Scalar
    rounds: Int[Array, ""]


def align_head(
    model: ActiveShapeModel,
    points: Landmarks,
    weights: Weights | None = None,
    *,
    noise: float | None = None,
    most_rounds: int | Int[Array, ""] = _MOST_ROUNDS,
) -> Alignment:
    """Coefficients and camera of a 3D shape model for 2D landmarks, in turns until the error stops falling (Figure 7).

    Two things differ from the thesis. It solves for b by plain least squares, which explains errors of landmarks by
    depths that no face has; here b is weighed against its deviations. And it solves for b as if the camera stayed as it
    is, which takes hundreds of rounds, because most of what b does to the landmarks the next camera takes back; here
    b is solved for a camera that follows it, and some five rounds are enough.

    Args:
        model: the 3D shape model, of L landmarks.
        points: (L, 2) landmarks, in pixels; may be anything where the weight is 0.
        weights: (L,) how much each landmark counts, 0 for those that are not known; None counts all alike.
        noise: standard deviation of the landmarks' errors, in the model's unit; None estimates it from what is left
            over in each round, 0 trusts them fully, as the thesis does.
        most_rounds: after this many rounds the best result so far is returned.
    """
    weights = jnp.ones(len(points), points.dtype) if weights is None else weights
    known = jnp.where((weights > 0)[:, None], points, 0.0)

    def seen_with(b: Coefficients) -> Alignment:
        head = model.reconstruct(b)
        camera = align_shapes(head, points, weights)
        return Alignment(b, camera, _error(show(head, camera), known, weights), jnp.array(0, jnp.int32))

    def another(state: tuple[Alignment, Scalar]) -> tuple[Alignment, Scalar]:
        best, _ = state
        found = seen_with(_coefficients(model, known, weights, best, noise))
        better = found.camera.ok & (found.error < best.error)
        kept = jax.tree.map(partial(jnp.where, better), found, best)
        return kept._replace(rounds=best.rounds + 1), best.error

    def falling(state: tuple[Alignment, Scalar]) -> Bool[Array, ""]:
        best, before = state
        return best.camera.ok & (best.error < (1 - _AT_REST) * before) & (best.rounds < most_rounds)

    start = seen_with(jnp.zeros_like(model.deviations))
    return lax.while_loop(falling, another, (start, jnp.full_like(start.error, jnp.inf)))[0]


def refine_head(
    model: ActiveShapeModel,
    points: Landmarks,
    alignment: Alignment,
    weights: Weights | None = None,
    *,
    noise: float | None = None,
    steps: int = 60,
) -> Alignment:
    """Coefficients and camera together, by L-BFGS on the squared reprojection error and b's prior.

    ``AlignShapes`` averages the scales of a general camera; this is the best restricted one. In this sense it never
    makes the alignment worse.

    Args:
        model: the 3D shape model, of L landmarks.
        points: (L, 2) landmarks, in pixels; may be anything where the weight is 0.
        alignment: where to start, from :func:`align_head`.
        weights: (L,) how much each landmark counts; None counts all alike.
        noise: standard deviation of the landmarks' errors, in the model's unit; None estimates it from the alignment.
        steps: of L-BFGS.
    """
    weights = jnp.ones(len(points), points.dtype) if weights is None else weights
    known = jnp.where((weights > 0)[:, None], points, 0.0)
    start = alignment.camera
    angles = rotation_angles(start.rotation)
    # A step of 1 in an angle or in the scale's logarithm then moves the landmarks about as far as one in the first b.
    reach = model.deviations[0] / jnp.sqrt(jnp.sum(model.mean**2))
    explained, _ = _evidence(model, known, weights, alignment)
    variance = _variance(model, known, weights, alignment, explained) if noise is None else noise**2
    precision = 1 / jnp.maximum(variance, 1e-6)

    def aligned(step: Float[Array, "params"]) -> tuple[Coefficients, Camera]:
        b, turn, growth, move = step[:-_POSE], step[-_POSE:-3], step[-3], step[-2:]
        rotation = rotation_matrix(*(angles + reach * turn))
        scale = start.scale * jnp.exp(reach * growth)
        return b * model.deviations, Camera(scale, rotation, start.place + start.scale * move, start.ok)

    def cost(step: Float[Array, "params"]) -> Scalar:
        b, camera = aligned(step)
        apart = (show(model.reconstruct(b), camera)[:, :2] - known) / start.scale
        return (precision * jnp.sum(weights[:, None] * apart**2) + jnp.sum(step[:-_POSE] ** 2)) / 2

    import optax  # not before: few refine, and all would wait for it

    optimiser = optax.lbfgs(linesearch=optax.scale_by_zoom_linesearch(max_linesearch_steps=10))
    value_and_slope = optax.value_and_grad_from_state(cost)

    def another(state: tuple[Array, optax.OptState], _: None) -> tuple[tuple[Array, optax.OptState], None]:
        step, memory = state
        value, slope = value_and_slope(step, state=memory)
        with mixing_types():
            update, memory = optimiser.update(slope, memory, step, value=value, grad=slope, value_fn=cost)
        return (step + update, memory), None

    first = jnp.concatenate([alignment.b / model.deviations, jnp.zeros(_POSE, alignment.b.dtype)])
    last = lax.scan(another, (first, optimiser.init(first)), None, length=steps)[0][0]
    better = start.ok & (cost(last) < cost(first))
    b, camera = jax.tree.map(partial(jnp.where, better), aligned(last), (alignment.b, start))
    return Alignment(b, camera, _error(show(model.reconstruct(b), camera), known, weights), alignment.rounds)


def _coefficients(
    model: ActiveShapeModel, points: Landmarks, weights: Weights, best: Alignment, noise: float | None
) -> Coefficients:
    """The most likely b for landmarks: B₂D† (L₂D - B₂D₀) of Figure 7, with a prior on b and a camera that follows."""
    explained, right = _evidence(model, points, weights, best)
    variance = _variance(model, points, weights, best, explained) if noise is None else noise**2
    return model.deviations * _solve(explained + variance * jnp.eye(len(explained), dtype=explained.dtype), right)


def _evidence(
    model: ActiveShapeModel, points: Landmarks, weights: Weights, best: Alignment
) -> tuple[Float[Array, "modes modes"], Coefficients]:
    """The normal equations that landmarks give for b in standard deviations, with a camera that follows."""
    count, camera = len(model.deviations), best.camera
    root = jnp.sqrt(weights)[:, None]
    head = jnp.matmul(model.reconstruct(best.b), camera.rotation.T, precision=_EXACT)
    modes = jnp.einsum("mld,ed->mle", model.modes, camera.rotation[:2], precision=_EXACT)
    modes = (root * model.deviations[:, None, None] * modes).reshape(count, -1)
    missing = (root * ((points - camera.place) / camera.scale - head[:, :2])).reshape(-1)
    missing = missing + jnp.matmul(best.b / model.deviations, modes, precision=_EXACT)
    # What the camera can do by itself is no evidence for b.
    moves = (root * _camera_moves(head)).reshape(_POSE, -1)
    follows = _solve(jnp.matmul(moves, moves.T, precision=_EXACT), jnp.matmul(moves, modes.T, precision=_EXACT))
    modes = modes - jnp.matmul(follows.T, moves, precision=_EXACT)
    return jnp.matmul(modes, modes.T, precision=_EXACT), jnp.matmul(modes, missing, precision=_EXACT)


def _variance(
    model: ActiveShapeModel,
    points: Landmarks,
    weights: Weights,
    alignment: Alignment,
    explained: Float[Array, "modes modes"],
) -> Scalar:
    """Of the landmarks' errors, a coordinate, in the model's unit: what an alignment leaves over is less than they were
    by what b and the camera have explained of them."""
    camera, known = alignment.camera, 2 * weights.sum()
    apart = (show(model.reconstruct(alignment.b), camera)[:, :2] - points) / jnp.maximum(camera.scale, 1e-6)
    squares = jnp.maximum(jnp.sum(weights[:, None] * apart**2), 1e-12)
    prior = squares / jnp.maximum(known, 1e-12) * jnp.eye(len(explained), dtype=explained.dtype)
    spent = _POSE + jnp.trace(_solve(explained + prior, explained))
    return squares / jnp.maximum(known - spent, 1.0)


def _camera_moves(head: Landmarks3D) -> Float[Array, "6 landmarks 2"]:
    """How points move in the picture as a camera turns about its three axes, grows, and moves right and down."""
    x, y, z = head.T
    none, one = jnp.zeros_like(x), jnp.ones_like(x)
    ways = ((none, -z), (z, none), (-y, x), (x, y), (one, none), (none, one))
    return jnp.stack([jnp.stack(way, 1) for way in ways])


def _error(shown: Landmarks3D, points: Landmarks, weights: Weights) -> Scalar:
    return jnp.sum(weights * jnp.sqrt(jnp.sum((shown[:, :2] - points) ** 2, 1) + 1e-12))


# One system after the other also in batches: on a CPU, batches are solved by threads that wait for threads of the same
# few, and where two computations do so at once neither may ever end.
@jax.custom_batching.sequential_vmap
def _solve(normal: Float[Array, "n n"], right: Float[Array, "n *more"]) -> Float[Array, "n *more"]:
    """By normal equations with a trace of damping, for what the view does not show."""
    return jnp.linalg.solve(normal + 1e-7 * jnp.trace(normal) * jnp.eye(len(normal), dtype=normal.dtype), right)
