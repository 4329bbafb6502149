"""Several fits of the same faces made one, such as from several detectors' boxes, or from boxes moved a little."""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax import numpy as jnp

from jaxfit.cascade.fit import centroid
from jaxfit.errors import InputError
from jaxfit.fitting.fits import Fits
from jaxfit.modes import computing

_SURE = 1.0001  # so that the odds of 1 are finite
_DOUBT = 1e-9  # least weight of a fit, so that the weights of a face never sum to 0


@computing
def fuse(fits: Sequence[Fits], way: str = "odds") -> np.ndarray:
    """One set of landmarks for each face, from several fits of it.

    Ways: ``"centroid"``, the fit nearest to all others (thesis 3.2.3, Eq. 12); ``"median"`` and ``"mean"`` of each
    coordinate; by the confidence c of each fit, ``"confidence"`` and ``"odds"``, the means weighted by c and by c /
    (1 - c), and ``"surest"``, the fit with the highest c; and ``"precision"``, the mean of each landmark weighted by
    the inverses of its covariances. docs/measured/fusion.md compares them.

    Args:
        fits: of the same N faces in the same order, as `fit` gives them; a face that one of them did not fit is fused
            from the others.
        way: how.

    Returns:
        (N, L, 2) landmarks, in the pixels of each picture; NaN for faces that none has fitted.

    Raises:
        InputError: no fits, fits of other numbers of faces or landmarks, an unknown way, or one that needs a confidence
            or covariances which the model does not have.
    """
    if way not in (*WAYS, _PRECISE):
        raise InputError(f"expected a way among {', '.join((*WAYS, _PRECISE))}; got {way!r}")
    if len({each.landmarks.shape for each in fits}) != 1:
        shapes = ", ".join(str(each.landmarks.shape) for each in fits)
        raise InputError(f"expected fits of the same faces and landmarks, one or more; got {shapes or 'none'}")
    known = [each.confidence for each in fits if each.confidence is not None]
    if way in _TRUSTING and len(known) < len(fits):
        raise InputError(f"expected fits with a confidence for the way {way!r}; median, centroid and mean need none")
    landmarks = np.stack([each.landmarks for each in fits], 1)
    confidence = np.stack(known, 1) if len(known) == len(fits) else np.zeros(landmarks.shape[:2])
    fused = np.full(landmarks[:, 0].shape, np.nan)
    some = np.isfinite(landmarks).all((2, 3)).any(1)
    if way == _PRECISE:
        covariances = [each.covariances for each in fits if each.covariances is not None]
        if len(covariances) < len(fits):
            raise InputError(f"expected fits with covariances for the way {way!r}; the model has none")
        fused[some] = _precisely(landmarks[some], np.stack(covariances, 1)[some])
        return fused
    fused[some] = WAYS[way](landmarks[some], confidence[some])
    return fused


def _precisely(landmarks: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """The most likely landmarks (N, L, 2), of fits (N, S, L, 2) that err independently by covariances."""
    known = _fitted(landmarks)[..., None, None]
    precisions = np.where(known[..., None], np.linalg.inv(np.where(known[..., None], covariances, np.eye(2))), 0.0)
    sums = np.einsum("nslij,nslj->nli", precisions, np.where(known, landmarks, 0.0))
    return np.linalg.solve(precisions.sum(1), sums[..., None])[..., 0]


def _centroid(landmarks: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    return _chosen(landmarks, np.asarray(jax.vmap(centroid)(jnp.asarray(landmarks, jnp.float32))))


def _surest(landmarks: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    return _chosen(landmarks, np.where(_fitted(landmarks), confidence, -1.0).argmax(1))


def _weighted(landmarks: np.ndarray, weights: np.ndarray) -> np.ndarray:
    known = _fitted(landmarks)
    weights = np.where(known, np.nan_to_num(weights) + _DOUBT, 0.0)
    shares = weights / weights.sum(1, keepdims=True)
    return np.einsum("ns,nslc->nlc", shares, np.where(known[..., None, None], landmarks, 0.0))


def _chosen(landmarks: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    return landmarks[np.arange(len(landmarks)), numbers]


def _fitted(landmarks: np.ndarray) -> np.ndarray:
    return np.isfinite(landmarks).all((2, 3))


# Of landmarks (N, fits, L, 2), some fit of each face finite, and confidences (N, fits): landmarks (N, L, 2).
WAYS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "centroid": _centroid,
    "median": lambda landmarks, confidence: np.nanmedian(landmarks, 1),
    "mean": lambda landmarks, confidence: np.nanmean(landmarks, 1),
    "confidence": _weighted,
    "odds": lambda landmarks, confidence: _weighted(landmarks, confidence / (_SURE - confidence)),
    "surest": _surest,
}
_PRECISE = "precision"
_TRUSTING = ("confidence", "odds", "surest")
