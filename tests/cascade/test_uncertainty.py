"""Uncertainties are covariances whatever their outputs; they grow with the face, and change nothing of the fits."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import scipy
from blobs import FRAME, SPACE, SPREAD, Patch, blob_faces, training_set
from jax import numpy as jnp

from jaxfit.cascade.confidence import Clues, count_moves
from jaxfit.cascade.fit import find as find_unjitted
from jaxfit.cascade.fit import find_clues, fit_crops
from jaxfit.cascade.greedy import Greedy, train_cascade
from jaxfit.cascade.starts import Starts
from jaxfit.cascade.uncertainty import FREEDOM, Uncertainty, region_radius, scatters_of

STEPS = 2
find = jax.jit(find_unjitted)


@pytest.fixture(scope="module")
def cascade():
    crops, landmarks = blob_faces(60, seed=1)
    options = Greedy(windows=(0.6, 0.4), augmentations=3, variance=0.95, ridge=1.0)
    return train_cascade(SPACE, Patch(), FRAME, training_set(crops, landmarks), SPREAD, options)


def uncertainty_of(landmarks: int, descriptor: int, moves: int, hidden: int = 5, axes: int = 3) -> Uncertainty:
    rng = np.random.default_rng(2)
    sizes = {
        "seen": (landmarks * descriptor, hidden),
        "moved": (moves, hidden),
        "shape": (landmarks, 2, hidden),
        "biases": (hidden,),
        "axes": (descriptor, axes),
        "centre": (axes,),
        "own": (landmarks, 2, axes, 4),
        "output": (hidden, landmarks, 4),
        "offset": (landmarks, 4),
    }
    return Uncertainty(**{name: jnp.asarray(0.3 * rng.normal(size=size), jnp.float32) for name, size in sizes.items()})


def of_cascade(cascade) -> Uncertainty:
    count = len(SPACE.mean)
    return uncertainty_of(count, cascade.weights[0].shape[0] // count, count_moves(STEPS))


@pytest.mark.parametrize("large", [0.1, 1.0, 1e3])
def test_whatever_the_outputs_covariances_are_positive_definite_and_have_finite_slopes(large: float) -> None:
    raw = jnp.asarray(large * np.random.default_rng(0).normal(size=(200, 4)), jnp.float32)
    found = np.asarray(scatters_of(raw), np.float64)
    np.testing.assert_allclose(found, found.swapaxes(1, 2))
    variances = np.linalg.eigvalsh(found)
    assert variances.min() > 0
    assert np.isfinite(variances).all()
    slopes = jax.grad(lambda raw: jnp.log(jnp.linalg.det(scatters_of(raw))).sum())(raw[:20])
    assert jnp.isfinite(slopes).all()


@pytest.mark.parametrize("share", [0.5, 0.9, 0.95])
def test_regions_hold_what_they_claim_of_errors_with_heavy_tails(share: float) -> None:
    scatter = np.array([[2.0, 0.7], [0.7, 1.0]])
    drawn = scipy.stats.multivariate_t(shape=scatter, df=FREEDOM, seed=0).rvs(40000)
    covariance = scatter * FREEDOM / (FREEDOM - 2)
    lengths = np.sqrt(np.einsum("ni,ij,nj->n", drawn, np.linalg.inv(covariance), drawn))
    assert (lengths <= region_radius(share)).mean() == pytest.approx(share, abs=0.01)


def test_covariances_grow_with_the_face_and_nothing_else_does(cascade) -> None:
    crops, _ = blob_faces(1, seed=9)
    landmarks, clues = find_clues(cascade, crops, Starts().rotations)
    uncertainty, alone = of_cascade(cascade), jax.tree.map(lambda part: part[0], clues)
    near = uncertainty(alone, landmarks[0])
    far = uncertainty(alone, 3 * landmarks[0] + 50)
    np.testing.assert_allclose(far.covariances, 9 * near.covariances, rtol=2e-3)
    np.testing.assert_allclose(far.visible, near.visible, atol=1e-4)


@pytest.mark.parametrize("starts", [Starts(), Starts(3, -25.0, 25.0)], ids=["one start", "three"])
def test_an_uncertainty_changes_nothing_and_is_that_of_the_best_fit(cascade, starts) -> None:
    crops, _ = blob_faces(6, seed=9)
    uncertainty = of_cascade(cascade)
    found = find(cascade, None, crops, starts.rotations, uncertainty=uncertainty)
    landmarks, clues = find_clues(cascade, crops, starts.rotations)
    np.testing.assert_array_equal(landmarks, fit_crops(cascade, crops, starts))
    np.testing.assert_allclose(found["landmarks"], landmarks, atol=1e-4)
    for face in range(len(crops)):
        own = Clues(*(part[face] for part in clues))
        doubt = uncertainty(own, landmarks[face])
        np.testing.assert_allclose(found["covariances"][face], doubt.covariances, rtol=2e-3, atol=1e-4)
        np.testing.assert_allclose(found["visible"][face], doubt.visible, atol=1e-4)


def test_a_fit_that_diverged_has_no_covariances(cascade) -> None:
    wild = replace(cascade, biases=cascade.biases.at[0].set(jnp.nan))
    crops, _ = blob_faces(2, seed=0)
    found = find(wild, None, crops, Starts().rotations, uncertainty=of_cascade(cascade))
    assert jnp.isnan(found["covariances"]).all()
    assert jnp.isnan(found["visible"]).all()
