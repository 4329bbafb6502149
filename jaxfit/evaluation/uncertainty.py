"""Whether landmarks are as far off as fits say, and hidden where fits say so."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxfit.cascade.uncertainty import region_radius
from jaxfit.errors import InputError
from jaxfit.evaluation.calibration import auroc
from jaxfit.evaluation.evaluate import Evaluation
from jaxfit.fitting.fits import mahalanobis
from jaxfit.schemes.conversions import sources

SHARES = (0.5, 0.9, 0.95)  # of the true landmarks, that regions claim to hold
_FEWEST = 5  # landmarks of a face between which ranks are compared


@dataclass(frozen=True)
class LandmarkDoubts:
    """What fits of N faces say of each of L landmarks, beside what is true.

    Attributes:
        lengths: (N, L) how far the true landmark is from the fitted one, in standard deviations of its covariance; NaN
            where the label, or the covariance, is not known.
        deviations: (N, L) roots of the mean variances in x and y, in pixels.
        distances: (N, L) pixels between the true and the fitted landmark.
        visible: (N, L) probabilities that landmarks can be seen.
        seen: (N, L) 1 for landmarks that are labelled as visible, 0 for those labelled as hidden, or missing; NaN where
            labels do not say.
    """

    lengths: np.ndarray
    deviations: np.ndarray
    distances: np.ndarray
    visible: np.ndarray
    seen: np.ndarray

    def held(self, share: float) -> float:
        """The share of the true landmarks in regions that claim to hold ``share``; NaN without any."""
        known = self.lengths[np.isfinite(self.lengths)]
        return float((known <= region_radius(share)).mean()) if len(known) else float("nan")

    @property
    def ranks(self) -> float:
        """Within faces, the rank correlation (Spearman) of deviations and distances, on average; NaN where there are no
        faces with five landmarks."""
        found = [
            _rank_correlation(deviations[known], distances[known])
            for deviations, distances in zip(self.deviations, self.distances, strict=True)
            if (known := np.isfinite(deviations) & np.isfinite(distances)).sum() >= _FEWEST
        ]
        return float(np.mean(found)) if found else float("nan")

    @property
    def hidden(self) -> float:
        """How often a hidden landmark looks less visible than a visible one (AUROC); NaN where labels name only one
        kind."""
        known = np.isfinite(self.seen) & np.isfinite(self.visible)
        return auroc(self.visible[known], self.seen[known] == 1)

    def some(self, faces: np.ndarray) -> "LandmarkDoubts":
        """Those of some faces: a mask (N,), or numbers."""
        return LandmarkDoubts(*(values[faces] for values in vars(self).values()))


def landmark_doubts(result: Evaluation) -> LandmarkDoubts:
    """What the fits of an evaluation say of their landmarks, in the scheme that errors are measured in; landmarks that
    are means of several have no covariance.

    Raises:
        InputError: the fits have no covariances.
    """
    fits = result.fits
    if fits.covariances is None or fits.visible is None:
        raise InputError("expected fits with covariances, of a model with an uncertainty (--confidence); got others")
    made_of = sources(fits.scheme, result.scheme)
    covariances = np.full((len(fits), len(made_of), 2, 2), np.nan)
    for number, points in enumerate(made_of):
        if len(points) == 1:
            covariances[:, number] = fits.covariances[:, points[0]]
    visible = np.stack([fits.visible[:, list(points)].mean(1) for points in made_of], 1)
    truth = np.stack([np.where(face.known[:, None], face.landmarks, np.nan) for face in result.faces])
    seen = [np.where(face.known & face.visible, 1.0, np.where(face.visible, np.nan, 0.0)) for face in result.faces]
    return LandmarkDoubts(
        lengths=mahalanobis(truth - result.landmarks, covariances),
        deviations=np.sqrt((covariances[..., 0, 0] + covariances[..., 1, 1]) / 2),
        distances=result.distances,
        visible=visible,
        seen=np.stack(seen),
    )


def uncertainty_report(result: Evaluation) -> dict[str, Any]:
    """An evaluation's part of ``report.json`` on the uncertainty of its landmarks; nothing without one, or without
    faces."""
    if result.fits.covariances is None or not len(result.fits):
        return {}
    doubts = landmark_doubts(result)
    numbers = {f"regions_of_{share:.0%}".replace("%", "_percent"): doubts.held(share) for share in SHARES}
    numbers |= {"rank_correlation": doubts.ranks, "hidden_auroc": doubts.hidden}
    return {"uncertainty": {name: None if np.isnan(value) else round(value, 4) for name, value in numbers.items()}}


def _rank_correlation(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.corrcoef(one.argsort().argsort(), other.argsort().argsort())[0, 1])
