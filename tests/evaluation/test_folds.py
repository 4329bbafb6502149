"""Folds keep subjects whole, are balanced, and are the same for the same seed."""

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfit.errors import InputError
from jaxfit.evaluation.folds import split_by_subject


@st.composite
def datasets(draw: st.DrawFn) -> tuple[list[str], int, int]:
    sizes = draw(st.lists(st.integers(1, 9), min_size=2, max_size=15))
    subjects = [f"subject {i}" for i, size in enumerate(sizes) for _ in range(size)]
    folds = draw(st.integers(2, len(sizes)))
    return draw(st.permutations(subjects)), folds, draw(st.integers(0, 2**32 - 1))


@given(datasets())
def test_a_subject_is_in_one_fold(dataset: tuple[list[str], int, int]) -> None:
    subjects, _, _ = dataset
    folds_of = defaultdict(set)
    for subject, fold in zip(subjects, split_by_subject(*dataset), strict=True):
        folds_of[subject].add(fold)
    assert all(len(folds) == 1 for folds in folds_of.values())


@given(datasets())
def test_folds_are_balanced_and_none_is_empty(dataset: tuple[list[str], int, int]) -> None:
    subjects, folds, _ = dataset
    faces = np.bincount(split_by_subject(*dataset))
    assert faces.size == folds
    assert faces.min() >= 1
    assert faces.max() - faces.min() <= max(map(subjects.count, subjects))


@given(datasets(), st.randoms())
def test_the_order_of_faces_does_not_matter(dataset: tuple[list[str], int, int], random) -> None:
    subjects, folds, seed = dataset
    shuffled = random.sample(subjects, len(subjects))
    before = dict(zip(subjects, split_by_subject(*dataset), strict=True))
    assert before == dict(zip(shuffled, split_by_subject(shuffled, folds, seed), strict=True))


def test_one_face_a_subject_is_plain_cross_validation() -> None:
    folds = split_by_subject([str(i) for i in range(103)], 10, seed=0)
    assert folds.dtype.kind == "i"
    assert sorted(np.bincount(folds)) == [10] * 7 + [11] * 3


def test_the_seed_decides() -> None:
    subjects = [str(i) for i in range(40)]
    first = split_by_subject(subjects, 4, seed=0)
    np.testing.assert_array_equal(first, split_by_subject(subjects, 4, seed=0))
    assert (first != split_by_subject(subjects, 4, seed=1)).any()


@pytest.mark.parametrize("folds", [-1, 0, 1, 4])
def test_impossible_folds(folds: int) -> None:
    with pytest.raises(InputError, match=rf"from 2 to the number of subjects, 3; got {folds}"):
        split_by_subject(["a", "b", "c", "a"], folds, seed=0)


def test_no_faces_cannot_be_split() -> None:
    with pytest.raises(InputError, match="subjects, 0"):
        split_by_subject([], 2, seed=0)
