"""What evaluations say of landmarks' covariances and visibility, against what was drawn."""

from pathlib import Path

import numpy as np
import pytest
import scipy

from jaxfit.cascade.uncertainty import FREEDOM
from jaxfit.errors import InputError
from jaxfit.evaluation.evaluate import measure
from jaxfit.evaluation.uncertainty import landmark_doubts, uncertainty_report
from jaxfit.fitting.fits import Fits, mahalanobis
from jaxfit.labels.records import FaceRecord
from jaxfit.schemes.known import AFLW21, IBUG68
from jaxfit.schemes.scheme import Scheme

COUNT = 300


def drawn(scheme: Scheme) -> tuple[Fits, list[FaceRecord]]:
    """Fits whose errors are as their covariances say, half of the faces with hidden landmarks that look so."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 100, (COUNT, scheme.count, 2))
    deviations = np.exp(rng.normal(0, 0.5, (COUNT, scheme.count)))
    shape = np.array([[1.5, 0.5], [0.5, 0.8]])
    errors = scipy.stats.multivariate_t(shape=shape, df=FREEDOM, seed=1).rvs((COUNT, scheme.count))
    hidden = rng.random((COUNT, scheme.count)) < 0.2
    visible = np.clip(np.where(hidden, 0.3, 0.8) + rng.normal(0, 0.2, hidden.shape), 0, 1)
    faces = [
        FaceRecord(Path(f"{n}.png"), truth[n], np.ones(scheme.count, bool), ~hidden[n], None, None, str(n), str(n))
        for n in range(COUNT)
    ]
    fits = Fits(
        scheme=scheme,
        names=tuple(f"{n}.png" for n in range(COUNT)),
        sizes=np.full((COUNT, 2), 100),
        pictures=np.arange(COUNT),
        boxes=np.full((COUNT, 4), 50.0),
        kinds=("square",) * COUNT,
        rotations=np.zeros(COUNT),
        landmarks=truth - deviations[..., None] * errors,
        covariances=deviations[..., None, None] ** 2 * shape * FREEDOM / (FREEDOM - 2),
        visible=visible,
    )
    return fits, faces


def test_regions_and_visibility_are_judged_by_labels() -> None:
    fits, faces = drawn(AFLW21)
    doubts = landmark_doubts(measure(fits, faces))
    for share in (0.5, 0.9, 0.95):
        assert doubts.held(share) == pytest.approx(share, abs=0.015)
        assert fits.inside(np.stack([face.landmarks for face in faces]), share).mean() == doubts.held(share)
    expected = [
        scipy.stats.spearmanr(one, other).statistic
        for one, other in zip(doubts.deviations, doubts.distances, strict=True)
    ]
    assert doubts.ranks == pytest.approx(np.mean(expected), abs=1e-6)
    assert doubts.hidden == pytest.approx(0.96, abs=0.02)
    report = uncertainty_report(measure(fits, faces))["uncertainty"]
    assert report["regions_of_90_percent"] == pytest.approx(doubts.held(0.9), abs=1e-4)
    assert len(doubts.some(np.arange(10)).lengths) == 10


def test_in_another_scheme_means_of_points_have_no_covariance() -> None:
    fits, faces = drawn(IBUG68)
    aflw = [
        FaceRecord(face.image, np.zeros((21, 2)), np.arange(21) < 15, np.arange(21) < 15, None, None, "a", face.face)
        for face in faces
    ]
    doubts = landmark_doubts(measure(fits, aflw, scheme=AFLW21))
    known = np.isfinite(doubts.lengths).all(0)
    np.testing.assert_array_equal(np.flatnonzero(~known), [7, 10, 15, 16, 17, 18, 19, 20])  # means, and unlabelled ones
    np.testing.assert_array_equal(doubts.seen[0], np.arange(21) < 15)


def test_fits_without_covariances_say_nothing() -> None:
    fits, faces = drawn(AFLW21)
    plain = Fits(**{**vars(fits), "covariances": None, "visible": None})
    assert uncertainty_report(measure(plain, faces)) == {}
    with pytest.raises(InputError, match="expected fits with covariances"):
        landmark_doubts(measure(plain, faces))
    with pytest.raises(InputError, match=r"0 < share < 1; got a share of 1\.5"):
        fits.inside(fits.landmarks, 1.5)


def test_lengths_are_mahalanobis_distances() -> None:
    rng = np.random.default_rng(3)
    factors, offsets = rng.normal(size=(20, 2, 2)), rng.normal(size=(20, 2))
    covariances = factors @ factors.swapaxes(1, 2) + 0.1 * np.eye(2)
    expected = [
        scipy.spatial.distance.mahalanobis(offset, [0, 0], np.linalg.inv(covariance))
        for offset, covariance in zip(offsets, covariances, strict=True)
    ]
    np.testing.assert_allclose(mahalanobis(offsets, covariances), expected)
