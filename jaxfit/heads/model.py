"""Head models: how landmarks lie on heads in 3D, learned from many; files of them, and the one of the package."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from safetensors.numpy import load as parse_tensors

from jaxfit.errors import InputError, ModelError
from jaxfit.models.files import DAMAGE, check_target, names_in, read_header, read_named, write_tensors
from jaxfit.modes import computing
from jaxfit.schemes.conversions import sources
from jaxfit.schemes.known import LFPW27, LFPW29, scheme_named
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.asm import ActiveShapeModel, learn_shape_model
from jaxfit.shapes.procrustes import generalised_procrustes

HEAD_FORMAT = 1
DEFAULT_HEAD_MODEL = "ict-facekit"

_KEY = "jaxfit-head"
_BUNDLED = "jaxfit.heads"


@dataclass(frozen=True)
class HeadModel:
    """A 3D Active Shape Model of all points of several landmark schemes together.

    Attributes:
        shape: the points' mean and modes, in centimetres; x right, y down, z away from the viewer, who sees the mean
            head from the front.
        sets: for each scheme, by name, the indices of its points, in its order.
        source: what it was learned from: attribution and licence, to be shown to users.
    """

    shape: ActiveShapeModel
    sets: dict[str, tuple[int, ...]]
    source: str

    def of(self, scheme: Scheme, variance: float) -> ActiveShapeModel:
        """The 3D Active Shape Model of one scheme's points alone, in cm: what this model, a Gaussian, says of them.

        Its modes are the principal axes of their covariance Σ σᵢ² mᵢ mᵢᵀ, less what moves, turns and scales their mean:
        that is the camera's. As many are kept as hold the share ``variance`` of what is left.

        Raises:
            InputError: the head model lacks the scheme, or ``variance`` is not in (0, 1].
        """
        return self.of_points(self.indices(scheme), variance)

    def in_pixels(self, scheme: Scheme, variance: float, side: float) -> ActiveShapeModel:
        """As :meth:`of`, in pixels of a picture in which the mean's larger side is ``side``, seen from the front.

        Raises:
            InputError: as :meth:`of`.
        """
        in_cm = self.of(scheme, variance)
        return in_cm.scaled(side / jnp.ptp(in_cm.mean[:, :2], 0).max())

    def indices(self, scheme: Scheme) -> tuple[int, ...]:
        """Which of its points are a scheme's, in the scheme's order.

        Raises:
            InputError: the head model lacks the scheme.
        """
        if scheme.name not in self.sets:
            raise InputError(
                f"this head model has no points of scheme {scheme.name}; it has {', '.join(self.sets)}: models of "
                "other schemes find no heads"
            )
        return self.sets[scheme.name]

    @computing
    def of_points(self, chosen: Sequence[int], variance: float) -> ActiveShapeModel:
        """As :meth:`of`, of the points of given indices.

        Raises:
            InputError: ``variance`` is not in (0, 1].
        """
        if not 0 < variance <= 1:
            raise InputError(f"expected a share of the shape's variance to keep, 0 < variance <= 1; got {variance}")
        indices = list(chosen)
        mean = np.asarray(self.shape.mean, np.float64)[indices]
        modes = np.asarray(self.shape.modes, np.float64)[:, indices]
        # The covariance is scaledᵀ scaled; its eigenvectors are the right singular vectors.
        scaled = np.asarray(self.shape.deviations, np.float64)[:, None] * modes.reshape(len(modes), -1)
        moves = np.linalg.qr(_similarity_moves(mean).T)[0]
        scaled = scaled - scaled @ moves @ moves.T
        _, deviations, axes = np.linalg.svd(scaled, full_matrices=False)
        # What the file's rounding leaves is no variation.
        reliable = int(np.sum(deviations > max(scaled.shape) * np.finfo(np.float32).eps * deviations[0]))
        held = np.cumsum(deviations**2)
        kept = min(reliable, int(np.searchsorted(held, variance * held[-1])) + 1)
        return ActiveShapeModel(
            mean=jnp.asarray(mean - mean.mean(0), jnp.float32),
            modes=jnp.asarray(axes[:kept].reshape(kept, *mean.shape), jnp.float32),
            deviations=jnp.asarray(deviations[:kept], jnp.float32),
        )


@computing
def learn_head_model(heads: np.ndarray, sets: Mapping[str, tuple[int, ...]], variance: float, source: str) -> HeadModel:
    """The head model of many heads: generalised Procrustes analysis, then PCA.

    The mean is as large as the heads are on average, and turned as they are on average: give heads that look straight
    at the viewer. Where the 29 points of LFPW are a set, its 27 become one as well.

    Args:
        heads: (N, L, 3) landmarks in cm; x right, y down, z away from the viewer.
        sets: for each scheme, by name, the indices of its points among the L, in its order.
        variance: share of the heads' variance to keep, in (0, 1].
        source: attribution and licence of the heads.

    Raises:
        InputError: the heads are all equal or not to be aligned, ``variance`` is not in (0, 1], or a set does not fit
            its scheme.
    """
    sets = dict(sets)
    if LFPW29.name in sets:
        sets[LFPW27.name] = tuple(sets[LFPW29.name][index] for (index,) in sources(LFPW29, LFPW27))
    if heads.ndim != 3 or heads.shape[2] != 3 or not np.isfinite(heads).all():
        raise InputError(f"expected finite landmarks (N, L, 3) of heads, got {heads.shape}")
    if problem := _unfit_set(sets, heads.shape[1]):
        raise InputError(problem)
    found = generalised_procrustes(jnp.asarray(heads - heads.mean(1, keepdims=True), jnp.float32))
    if not found.converged:
        raise InputError(f"the heads do not come together after {int(found.rounds)} rounds; are they the same points?")
    radii = np.sqrt(heads.var(1).sum(1))
    return HeadModel(learn_shape_model(found.aligned * float(radii.mean()), variance), sets, source)


@computing
def save_head_model(head: HeadModel, path: str | Path) -> None:
    """Write a head model to ``path`` (ending in ``.safetensors``), atomically; the same model gives the same bytes.

    Raises:
        InputError: the name does not end in ``.safetensors``, its folder does not exist, or the model could not be
            loaded again.
    """
    path = Path(path)
    check_target(path)
    tensors = {name: np.asarray(array, np.float32) for name, array in vars(head.shape).items()}
    if problem := _unfit_shape(tensors) or _unfit_set(head.sets, len(tensors["mean"])):
        raise InputError(f"not saved: {problem}")
    sets = {name: list(indices) for name, indices in head.sets.items()}
    write_tensors(path, tensors, _KEY, {"format": HEAD_FORMAT, "sets": sets, "source": head.source})


def bundled_head_models() -> list[str]:
    """Names of the head models that come with the package."""
    return names_in(_BUNDLED)


@computing
def load_head_model(name: str | Path = DEFAULT_HEAD_MODEL) -> HeadModel:
    """Load a bundled head model by name, or a file of one by path.

    Raises:
        ModelError: no such head model, or a file that is damaged or of another format version.
    """
    data = read_named(name, _BUNDLED, "head model")
    try:
        header = read_header(data, _KEY, HEAD_FORMAT, "head model")
        tensors = parse_tensors(data)
        sets = {scheme: tuple(indices) for scheme, indices in header["sets"].items()}
        if problem := _unfit_shape(tensors) or _unfit_set(sets, len(tensors["mean"])):
            raise ModelError(f"damaged: {problem}; copy or build it again")
        if not isinstance(header["source"], str):
            raise ModelError(f"damaged: expected the source in words, got {header['source']!r}; copy or build it again")
    except ModelError as error:
        raise ModelError(f"{name}: {error}") from None
    except DAMAGE as error:
        raise ModelError(f"{name}: not a head model, or damaged ({error}); copy or build it again") from None
    shape = ActiveShapeModel(*(jnp.asarray(tensors[part]) for part in ("mean", "modes", "deviations")))
    return HeadModel(shape, sets, header["source"])


def _similarity_moves(mean: np.ndarray) -> np.ndarray:
    """(7, 3 L) what points (L, 3) do as they move along the axes, turn about them, and grow."""
    centred = mean - mean.mean(0)
    shifts = [np.broadcast_to(axis, mean.shape) for axis in np.eye(3)]
    turns = [np.cross(axis, centred) for axis in np.eye(3)]
    return np.stack([*shifts, *turns, centred]).reshape(7, -1)


def _unfit_shape(tensors: Mapping[str, np.ndarray]) -> str | None:
    """What is wrong with the arrays of a shape model, in words; None if nothing is."""
    points, modes = len(tensors["mean"]), len(tensors["deviations"])
    expected = {"mean": (points, 3), "modes": (modes, points, 3), "deviations": (modes,)}
    for name, shape in expected.items():
        array = tensors[name]
        if array.shape != shape or not array.size or array.dtype != np.float32 or not np.isfinite(array).all():
            return f"expected {name} {shape} of finite 32-bit numbers, got {array.shape} {array.dtype}"
    return None if (tensors["deviations"] > 0).all() else "expected deviations larger than 0"


def _unfit_set(sets: Mapping[str, tuple[int, ...]], points: int) -> str | None:
    """What is wrong with the sets of indices among so many points, in words; None if nothing is."""
    for name, indices in sets.items():
        count = scheme_named(name).count
        if len(indices) != count or not all(type(index) is int and 0 <= index < points for index in indices):
            return f"expected {count} indices below {points} for scheme {name}, got {len(indices)}: {indices}"
    return None if sets else "expected at least one set of points"
