"""Heads aligned to labels: known ones give back their depths and poses, and nothing else is changed."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfit.heads.model import load_head_model
from jaxfit.labels.aligned import align_labels, with_depth
from jaxfit.schemes.known import AFLW21

MODEL = load_head_model().of(AFLW21, 0.95)
COUNT = 12


@pytest.fixture(scope="module")
def heads():
    """(N, 21, 3) pixels: x and y as they are seen, and depths from the mean face's centroid."""
    rng = np.random.default_rng(0)
    b = rng.normal(size=(COUNT, len(MODEL.deviations))) * np.asarray(MODEL.deviations)
    shapes = np.asarray(MODEL.mean) + np.tensordot(b, np.asarray(MODEL.modes), 1)
    turns = Rotation.from_euler("zxy", rng.uniform([-40, -25, -40], [40, 25, 40], (COUNT, 3)), degrees=True)
    turned = rng.uniform(10, 30, (COUNT, 1, 1)) * np.einsum("nij,nlj->nli", turns.as_matrix(), shapes)
    return turned + [200.0, 150.0, 0.0]


def sizes(heads):
    return np.ptp(heads[..., :2], 1).max(1)[:, None]


def test_depths_are_those_of_the_head(heads):
    found = with_depth(heads[..., :2], MODEL)
    np.testing.assert_array_equal(found[..., :2], heads[..., :2])
    assert (np.abs(found - heads)[..., 2] < 0.02 * sizes(heads)).all()
    # The tip of the nose is nearest, and the ears are farthest, of heads that look at the viewer.
    assert np.median(found[:, 14, 2] - found[:, [12, 16], 2].mean(1)) < 0


def test_unknown_labels_stay_unknown(heads):
    labels = heads[..., :2].copy()
    known = np.random.default_rng(1).random(labels.shape[:2]) < 0.8
    labels[~known] = np.nan
    labels[0, 3] = [np.nan, 5.0]  # half a label is none
    known[0, 3] = False
    found = with_depth(labels, MODEL)
    np.testing.assert_array_equal(np.isnan(found), np.broadcast_to(~known[..., None], found.shape))
    np.testing.assert_array_equal(found[known][:, :2], labels[known])
    assert np.nanmedian(np.abs(found - heads)[..., 2] / sizes(heads)) < 0.01


def test_faces_in_the_corner_of_large_pictures_lose_nothing(heads):
    corner = np.array([1e4, 1e4])
    near, far = (with_depth(heads[..., :2] + offset, MODEL) for offset in (0, corner))
    np.testing.assert_allclose(far[..., 2], near[..., 2], atol=2e-3)
    np.testing.assert_array_equal(far[..., :2], heads[..., :2] + corner)


def test_labels_that_determine_no_alignment_have_no_depth(heads):
    labels = heads[..., :2].copy()
    labels[0] = 40.0
    labels[1] = np.outer(np.arange(21), [2, 1])
    labels[2, 3:] = np.nan
    labels[3] = np.nan
    found = with_depth(labels, MODEL)
    assert np.isnan(found[:4, :, 2]).all()
    np.testing.assert_array_equal(found[..., :2], labels)
    # Nor do they change others'.
    np.testing.assert_allclose(found[4:], with_depth(heads[..., :2], MODEL)[4:], atol=1e-6)


def test_no_faces_have_no_depths():
    assert with_depth(np.zeros((0, 21, 2)), MODEL).shape == (0, 21, 3)


def test_batches_are_not_seen(heads):
    many = np.tile(heads[..., :2], (11, 1, 1))  # two full batches and a bit
    few, all_of_them = (align_labels(MODEL, labels) for labels in (heads[..., :2], many))
    assert all_of_them.ok.all()
    for field in ("landmarks", "pose", "b", "error", "ok"):
        values = getattr(few, field)
        expected = np.tile(values, (11,) + (1,) * (values.ndim - 1))
        np.testing.assert_allclose(getattr(all_of_them, field), expected, atol=1e-3, err_msg=field)
    assert (few.error < 0.01).all()
    assert align_labels(MODEL, np.zeros((0, 21, 2))).pose.shape == (0, 3)
