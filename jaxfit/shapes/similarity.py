"""The parametric method's shape space: an Active Shape Model, scaled along the axes, turned and moved (thesis 3.2)."""

from dataclasses import dataclass
from typing import ClassVar

import jax
from jax import lax
from jax import numpy as jnp
from jaxtyping import Array, Float

from jaxfit.errors import InputError
from jaxfit.shapes.asm import ActiveShapeModel, learn_shape_model, likely_radius
from jaxfit.shapes.procrustes import align_similarity, generalised_procrustes
from jaxfit.shapes.space import Start, rotate, wrapped
from jaxfit.types import Landmarks, Params, Scalar

_POSE = 5  # s_x, s_y, d_x, d_y, θ
_ROUNDS = 12  # of Gauss-Newton; it is at rest after half as many on real faces
_EXACT = lax.Precision.HIGHEST


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SimilarityASM:
    """p = ⟨b, s_x, s_y, d_x, d_y, θ⟩: coefficients, scales, place in crop pixels, rotation in radians.

    Attributes:
        model: the 2D Active Shape Model, in pixels of the canonical face.
        sigmas: radius, in standard deviations, of the ellipsoid that b is kept in; the thesis's is 3.
    """

    model: ActiveShapeModel
    sigmas: Scalar

    dimensions: ClassVar[int] = 2

    @property
    def size(self) -> int:
        """Number of parameters, m + 5."""
        return len(self.model.deviations) + _POSE

    @property
    def closed_under_rotation(self) -> bool:
        """Faces are stretched along the picture's axes, which do not turn with them."""
        return False

    def landmarks(self, params: Params) -> Landmarks:
        """L = R · (B₀ + Σ bᵢ Bᵢ) + T (Eq. 10, 11)."""
        b, scales, place, theta = _parts(params)
        return rotate(self.model.reconstruct(b), theta) * scales + place

    def scale(self, params: Params) -> Scalar:
        """s_m = (s_x + s_y) / 2 (thesis 3.2.2)."""
        return params[-5:-3].mean()

    def rotation(self, params: Params) -> Scalar:
        """θ."""
        return params[-1]

    def turned(self, params: Params, angle: Scalar) -> Params:
        """θ and the place turned; the scales stay.

        Eq. 11 scales along the axes of the frame, so that the landmarks of a stretched face turn exactly only if the
        stretch may turn with the axes.
        """
        b, scales, place, theta = _parts(params)
        return _joined(b, scales, rotate(place, angle), wrapped(theta + angle))

    def encode(self, landmarks: Landmarks) -> Params:
        """The least-squares parameters of known landmarks, b inside the ellipsoid.

        Gauss-Newton on all parameters from the best similarity; where b leaves the ellipsoid it is pulled back, and
        the pose is then the best one for it.
        """
        start = align_similarity(landmarks, self.model.mean)
        params = self.place(start._replace(scale=jnp.maximum(start.scale, 1e-6)))
        everything = jnp.ones(self.size, landmarks.dtype)
        for free in (everything, everything.at[:-_POSE].set(0.0)):
            params = lax.fori_loop(0, _ROUNDS, _improved, (self, landmarks, free, params))[-1]
        return params

    def place(self, start: Start) -> Params:
        """The mean face, b = 0, at a start."""
        b = jnp.zeros_like(self.model.deviations)
        return _joined(b, jnp.stack([start.scale, start.scale]), start.centre, start.rotation)

    def difference(self, target: Params, params: Params) -> Float[Array, "params"]:
        """b and θ by difference, θ the shorter way round; the place in units of s_m; the scales by log ratio.

        The thesis regresses plain differences. Free of scale, one regressor serves faces of all sizes (3.2.2).
        """
        to_b, to_scales, to_place, to_theta = _parts(target)
        b, scales, place, theta = _parts(params)
        return _joined(
            to_b - b, jnp.log(to_scales / scales), (to_place - place) / self.scale(params), wrapped(to_theta - theta)
        )

    def advance(self, params: Params, step: Float[Array, "params"]) -> Params:
        """Apply a step, and pull b back into the ellipsoid."""
        moved = self._moved(params, step)
        return moved.at[:-_POSE].set(self.model.restrict(moved[:-_POSE], self.sigmas))

    def _moved(self, params: Params, step: Float[Array, "params"]) -> Params:
        b, scales, place, theta = _parts(params)
        b_step, log_ratios, move, turn = _parts(step)
        return _joined(
            b + b_step, scales * jnp.exp(log_ratios), place + self.scale(params) * move, wrapped(theta + turn)
        )


_Search = tuple[SimilarityASM, Landmarks, Float[Array, "params"], Params]


def _improved(_: Array, search: _Search) -> _Search:
    """A round of Gauss-Newton: a space, landmarks, 1 for parameters that may change and 0 for others, parameters."""
    space, landmarks, free, params = search
    size = space.scale(params)  # errors in canonical pixels: the same problem for faces of all sizes
    units = jnp.concatenate([space.model.deviations, jnp.ones(_POSE, params.dtype)]) * free
    slopes = jax.jacfwd(lambda step: space.landmarks(space._moved(params, step)))(jnp.zeros_like(params))
    missing = (landmarks - space.landmarks(params)) / size
    step = units * _least_squares(slopes.reshape(-1, space.size) / size * units, missing.reshape(-1))
    b, log_ratios, move, turn = _parts(step)
    # Far from the solution the first steps may be wild.
    step = _joined(b, jnp.clip(log_ratios, -0.5, 0.5), move, turn)
    return space, landmarks, free, space.advance(params, step)


def learn_similarity_asm(
    faces: Float[Array, "faces landmarks 2"], side: float, variance: float, sigmas: float | None
) -> SimilarityASM:
    """The shape space of faces (N, L, 2), in any units (thesis 3.2.1): aligned, without stretches, and their PCA.

    Args:
        faces: what to learn from.
        side: of the bounding square of the mean face, in pixels, at scale 1.
        variance: share of the variance that the modes keep, in (0, 1].
        sigmas: radius of the ellipsoid in standard deviations; None takes :func:`likely_radius`.

    Raises:
        InputError: the faces cannot be aligned or are all alike, or ``variance`` is out of range.
    """
    found = generalised_procrustes(faces)
    if not found.converged:
        raise InputError(
            f"the faces could not be aligned to a common mean in {int(found.rounds)} rounds; look for wrong labels"
        )
    pixels = side / jnp.ptp(found.mean, 0).max()
    model = learn_shape_model(unstretched(found.aligned * pixels, found.mean * pixels), variance)
    radius = likely_radius(len(model.deviations)) if sigmas is None else sigmas
    return SimilarityASM(model, jnp.asarray(radius, model.mean.dtype))


def unstretched(aligned: Float[Array, "faces landmarks 2"], mean: Landmarks) -> Float[Array, "faces landmarks 2"]:
    """Faces, aligned to their mean, less what s_x and s_y can do to the mean.

    Modes that could stretch the mean, too, would leave open what is b and what is scale. (What is left cannot turn a
    mean that is symmetric, as faces nearly are, either.)
    """
    axes = jnp.eye(2, dtype=mean.dtype)[:, None, :] * mean  # (2, L, 2): the mean's x alone, its y alone
    axes = axes / jnp.sqrt(jnp.sum(axes**2, (1, 2), keepdims=True))
    deviations = aligned - mean
    return aligned - jnp.einsum("nld,kld,kme->nme", deviations, axes, axes, precision=_EXACT)


def _parts(params: Params) -> tuple[Float[Array, "modes"], Float[Array, "2"], Float[Array, "2"], Scalar]:
    return params[:-5], params[-5:-3], params[-3:-1], params[-1]


def _joined(b: Float[Array, "modes"], scales: Float[Array, "2"], place: Float[Array, "2"], theta: Scalar) -> Params:
    return jnp.concatenate([b, scales, place, theta[None]])


def _least_squares(matrix: Float[Array, "rows params"], right: Float[Array, "rows"]) -> Float[Array, "params"]:
    """By normal equations with a trace of damping: Gauss-Newton mends what they lose in precision."""
    normal = jnp.matmul(matrix.T, matrix, precision=_EXACT)
    damping = 1e-6 * jnp.trace(normal) * jnp.eye(len(normal), dtype=normal.dtype)
    return jnp.linalg.solve(normal + damping, jnp.matmul(matrix.T, right, precision=_EXACT))
