"""Several fits made one: by every way, with fits missing, and what cannot be fused."""

from dataclasses import replace

import numpy as np
import pytest

import jaxfit
from jaxfit.errors import InputError
from jaxfit.fitting.fits import Fits
from jaxfit.fitting.fuse import WAYS
from jaxfit.models.model import SQUARE
from jaxfit.schemes.known import AFLW21

SURE = (0.9, 0.8, 0.9, 0.95, 0.01)


def fits_of(landmarks: np.ndarray, confidence: float) -> Fits:
    count = len(landmarks)
    return Fits(
        scheme=AFLW21,
        names=("",) * count,
        sizes=np.full((count, 2), 200),
        pictures=np.arange(count),
        boxes=np.zeros((count, 4)),
        kinds=(SQUARE,) * count,
        rotations=np.zeros(count),
        landmarks=landmarks,
        confidence=np.full(count, confidence),
    )


@pytest.fixture
def fits() -> list[Fits]:
    """Of three faces: four fits around the right place, one far off that nobody trusts."""
    points = np.random.default_rng(0).normal(0, 1, (5, 3, 21, 2)) + 100
    points[4] += 50
    return [fits_of(each, sure) for each, sure in zip(points, SURE, strict=True)]


def test_several_fits_become_one(fits: list[Fits]) -> None:
    points = np.stack([each.landmarks for each in fits])
    found = {way: jaxfit.fuse(fits, way) for way in WAYS}
    assert all(of_way.shape == (3, 21, 2) for of_way in found.values())
    np.testing.assert_array_equal(found["surest"], points[3])
    np.testing.assert_allclose(found["mean"], points.mean(0))
    np.testing.assert_allclose(found["median"], np.median(points, 0))
    weights = np.array(SURE)[:, None, None, None]
    np.testing.assert_allclose(found["confidence"], (weights * points).sum(0) / weights.sum(0))
    np.testing.assert_array_equal(jaxfit.fuse(fits), found["odds"])
    off = {way: np.abs(of_way - 100).mean() for way, of_way in found.items()}
    assert off["mean"] > 8
    assert all(off[way] < 1 for way in WAYS if way != "mean")
    assert any((found["centroid"][0] == each).all() for each in points[:, 0])


@pytest.mark.parametrize("way", WAYS)
def test_faces_that_were_not_fitted_are_fused_from_the_others(fits: list[Fits], way: str) -> None:
    landmarks = [each.landmarks.copy() for each in fits]
    landmarks[0][0] = np.nan
    for each in landmarks:
        each[2] = np.nan
    holed = [
        replace(fit, landmarks=each, confidence=np.where(np.isfinite(each).all((1, 2)), sure, np.nan))
        for fit, each, sure in zip(fits, landmarks, SURE, strict=True)
    ]
    found = jaxfit.fuse(holed, way)
    np.testing.assert_allclose(found[0], jaxfit.fuse(fits[1:], way)[0])
    np.testing.assert_array_equal(found[1], jaxfit.fuse(fits, way)[1])
    assert np.isnan(found[2]).all()


def test_what_cannot_be_fused_is_said(fits: list[Fits]) -> None:
    with pytest.raises(InputError, match="expected a way among centroid, median"):
        jaxfit.fuse(fits, "best")
    with pytest.raises(InputError, match="one or more; got none"):
        jaxfit.fuse([])
    with pytest.raises(InputError, match="of the same faces and landmarks"):
        jaxfit.fuse([fits[0], fits_of(fits[1].landmarks[:2], 0.5)])
    silent = [replace(fits[0], confidence=None), *fits[1:]]
    with pytest.raises(InputError, match="with a confidence for the way 'odds'"):
        jaxfit.fuse(silent)
    assert np.isfinite(jaxfit.fuse(silent, "median")).all()


def test_precise_landmarks_count_more(fits: list[Fits]) -> None:
    """What several fits say, of covariances that are known, is the solution of weighted least squares."""
    rng = np.random.default_rng(5)
    factors = rng.normal(size=(len(fits), 3, 21, 2, 2))
    covariances = factors @ factors.swapaxes(-1, -2) + 0.05 * np.eye(2)
    doubtful = [replace(each, covariances=of_fit) for each, of_fit in zip(fits, covariances, strict=True)]
    fused = jaxfit.fuse(doubtful, "precision")
    roots = np.linalg.inv(np.linalg.cholesky(covariances[:, 2, 7])).reshape(-1, 2)
    points = np.concatenate(
        [root @ each.landmarks[2, 7] for root, each in zip(roots.reshape(-1, 2, 2), fits, strict=True)]
    )
    np.testing.assert_allclose(fused[2, 7], np.linalg.lstsq(roots, points, rcond=None)[0], rtol=1e-6)
    lost = doubtful[0].landmarks.copy()
    lost[1] = np.nan
    some = [replace(doubtful[0], landmarks=lost), *doubtful[1:]]
    np.testing.assert_allclose(jaxfit.fuse(some, "precision")[1], jaxfit.fuse(doubtful[1:], "precision")[1])
    with pytest.raises(InputError, match="with covariances for the way 'precision'"):
        jaxfit.fuse(fits, "precision")
