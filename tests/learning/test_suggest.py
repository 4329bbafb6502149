"""Which pictures are suggested: unsure ones before sure ones, different ones before alike ones."""

import numpy as np

from jaxfit.learning.suggest import ranked


def test_the_least_sure_object_comes_first_and_its_twin_late() -> None:
    places = np.array([[1.0, 0.0], [1.01, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    unsure = np.array([0.4, 0.39, 0.1, 0.2])
    assert ranked(unsure, places, np.zeros(2)).tolist() == [0, 3, 2, 1]


def test_where_all_differ_alike_uncertainty_ranks() -> None:
    unsure = np.random.default_rng(0).uniform(0.1, 1, 12)
    np.testing.assert_array_equal(ranked(unsure, np.eye(12), np.zeros(12)), np.argsort(-unsure))


def test_a_place_that_is_known_is_no_use() -> None:
    places = np.array([[0.0, 1.0], [0.0, 0.0], [2.0, 0.0]])
    assert ranked(np.array([0.9, 0.8, 0.1]), places, np.zeros(2)).tolist() == [0, 2, 1]
