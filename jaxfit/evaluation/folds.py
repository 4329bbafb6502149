"""Cross-validation folds that never split a person between training and testing (section 5)."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from jaxfit.errors import InputError


def split_by_subject(subjects: Sequence[str], folds: int, seed: int) -> np.ndarray:
    """The fold of each face: all faces of a subject share one, and folds hold about equally many faces.

    Subjects are shuffled, then dealt, those with most faces first, to the fold that is smallest so far. A
    subject's fold depends on the seed and the faces of each subject, not on the order of the faces.

    Args:
        subjects: the subject of each of N faces.
        folds: number of folds.
        seed: of the shuffle.

    Returns:
        (N,) fold indices in [0, folds); fold sizes differ by no more than the faces of the largest subject.

    Raises:
        InputError: fewer than two folds, or more folds than subjects.
    """
    faces = Counter(subjects)
    if not 2 <= folds <= len(faces):
        raise InputError(f"folds must be from 2 to the number of subjects, {len(faces)}; got {folds}")
    names = sorted(faces)
    shuffled = [names[i] for i in np.random.default_rng(seed).permutation(len(names))]
    sizes = [0] * folds
    fold_of: dict[str, int] = {}
    for name in sorted(shuffled, key=faces.__getitem__, reverse=True):
        fold_of[name] = sizes.index(min(sizes))
        sizes[fold_of[name]] += faces[name]
    return np.array([fold_of[name] for name in subjects])
