"""Choosing how to train by what whole cascades leave on people that they did not learn from.

Step by step, the best for a step itself is not the best for the steps that follow: here a setting is judged by the
error after the last step, one option after the other, and what is given stays unless another setting is better by more
than chance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from jaxfit.cascade.greedy import SharedAxes
from jaxfit.data.pictures import GreyPictures, Read
from jaxfit.errors import InputError
from jaxfit.evaluation.boxes import start_boxes
from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.statistics import signed_rank
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.methods import Options
from jaxfit.learning.prepare import part_of, usable_faces
from jaxfit.learning.train import train
from jaxfit.models.model import Model
from jaxfit.modes import computing
from jaxfit.schemes.normalisers import default_normaliser
from jaxfit.schemes.scheme import Scheme
from jaxfit.types import Progress, silent

# What is chosen, in this order: the windows last, as other ones need principal axes of their own.
OPTIONS = ("ridge", "variance", "spread", "windows")
# Windows are tried times factors that grow or shrink evenly from this for the first step to that for the last.
_SCHEDULES = ((1.2, 1.2), (1.0, 0.75), (1.0, 1.3))
# Starts of a face in training, at most: more change all settings alike.
_AUGMENTATIONS = 2
# Boxes that a face which is kept aside is fitted from.
_BOXES = 3
# Of a one-sided test.
_CHANCE = 0.025


@dataclass(frozen=True)
class Choice:
    """A setting of an option that was tried against the best options so far.

    Attributes:
        option: its name.
        value: its value.
        error: mean NMED (`default_normaliser`), at most 0.08, of faces of people kept aside.
        best: what the best options so far left of the same faces.
        faces: how many: not all, if the setting was no better on the first folds.
        p: of the signed-rank test by subject, that it is better by chance.
        taken: whether it was.
    """

    option: str
    value: float | tuple[float, ...]
    error: float
    best: float
    faces: int
    p: float
    taken: bool


@dataclass(frozen=True)
class Chosen:
    """How to train, and what was tried to find that out.

    Attributes:
        options: the options; all but ridge, variance, spread and windows are as they were given.
        choices: what was tried, in this order.
        folds: of the cross-validation.
    """

    options: Options
    choices: tuple[Choice, ...]
    folds: int

    def recorded(self, model: Model) -> Model:
        """The model, which says in ``training["chosen"]`` how its options were chosen."""
        choices = [asdict(trial) | {"value": np.asarray(trial.value).tolist()} for trial in self.choices]
        return replace(model, training=model.training | {"chosen": {"folds": self.folds, "trials": choices}})


def default_candidates(options: Options) -> dict[str, tuple[Any, ...]]:
    """What `choose_options` tries by default; windows are tried around those of ``options``."""
    windows = options.greedy.windows
    schedules = (np.geomspace(first, last, len(windows)) * windows for first, last in _SCHEDULES)
    return {
        "ridge": (0.3, 1.0, 3.0, 10.0),
        "variance": (0.9, 0.95, 0.98),
        "spread": (0.8, 1.0, 1.25),
        "windows": tuple(tuple(np.round(windows, 4).tolist()) for windows in schedules),
    }


@computing
def choose_options(
    faces: Sequence[FaceRecord],
    scheme: Scheme,
    *,
    method: str = "sdm",
    options: Options = Options(),
    candidates: Mapping[str, Sequence[Any]] | None = None,
    folds: int = 3,
    progress: Progress = silent,
    read: Read | None = None,
) -> Chosen:
    """Choose ridge, variance, spread and windows, one after the other, by the errors that cascades leave in the end on
    people that they did not learn from.

    Beginning with the given options, a setting takes the place of the best so far if its mean error is lower in all
    folds together, and by more than chance: signed-rank test by subject, one-sided p < 0.025. It is not tried on more
    folds once it has been no better on those before. All settings are tried with two starts a face at most, without the
    detectors, and share principal axes.

    Args:
        faces: the labelled faces; those with missing landmarks are left out.
        scheme: what their landmarks mean; it must have eye corners.
        method: as in `train`.
        options: what to begin with, and all that is not chosen; None for the defaults.
        candidates: settings by option, ``"ridge"``, ``"variance"``, ``"spread"`` or ``"windows"``; None for some of
            each.
        folds: parts of the people; each in turn is kept aside.
        progress: called with a stage's name, what is done and what there is to do.
        read: gets a picture's path and returns it grey, uint8 (H, W); the default remembers them.

    Raises:
        InputError: an unknown option or a setting out of range among the candidates, fewer people than folds, or as
            `train`.
    """
    given, seed = options, options.greedy.seed
    values = _checked(given, default_candidates(given) if candidates is None else candidates)
    usable, _ = usable_faces(faces, scheme)
    parts = split_by_subject([face.subject for face in usable], folds, seed)
    kept_aside = [np.flatnonzero(parts == fold) for fold in range(folds)]
    shared = [SharedAxes(max([given.greedy.variance, *values["variance"]])) for _ in range(folds)]
    read = read or GreyPictures()

    def errors_of(setting: Options, fold: int, about: str) -> np.ndarray:
        """The error of each face that is kept aside, the mean of those from several boxes."""
        learned = [face for face, part in zip(usable, parts, strict=True) if part != fold]
        tested = [usable[row] for row in kept_aside[fold]]
        how: dict[str, Any] = {"progress": part_of(progress, f"{about}, fold {fold + 1}/{folds}"), "read": read}
        model = train(learned, scheme, method=method, options=setting, axes=shared[fold], **how).model
        boxes = np.concatenate([start_boxes(tested, seed + number) for number in range(_BOXES)])
        relative = default_normaliser(scheme)
        errors = evaluate(model, tested * _BOXES, boxes, normaliser=relative, starts=setting.starts, **how).errors
        return np.minimum(errors, LIMIT).reshape(_BOXES, -1).mean(0)

    best = given.but(detectors=False, augmentations=min(given.greedy.augmentations, _AUGMENTATIONS))
    of_best: list[np.ndarray] = []
    choices = []
    for name, value in ((option, value) for option in OPTIONS for value in values[option]):
        if value == getattr(best.greedy, name):
            continue
        setting = best.but(**{name: value})
        errors: list[np.ndarray] = []
        for fold in range(folds):
            if fold == len(of_best):
                of_best.append(errors_of(best, fold, "best so far"))
            errors.append(errors_of(setting, fold, f"{name} {value}"))
            found, before = (np.concatenate(each[: fold + 1]) for each in (errors, of_best))
            ahead = bool(np.nanmean(found) < np.nanmean(before))
            if not ahead:
                break
        subjects = [usable[row].subject for rows in kept_aside[: len(errors)] for row in rows]
        p = signed_rank(found, before, subjects, alternative="less")
        taken = ahead and p < _CHANCE
        means = float(np.nanmean(found)), float(np.nanmean(before))
        choices.append(Choice(name, value, *means, len(found), p, taken))
        if taken:
            best, of_best = setting, errors
    return Chosen(given.but(**{name: getattr(best.greedy, name) for name in OPTIONS}), tuple(choices), folds)


def _checked(given: Options, candidates: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """The settings of all options that are chosen.

    Raises:
        InputError: another option, no number, or a setting out of range.
    """
    if set(candidates) - set(OPTIONS):
        raise InputError(f"expected candidates for {', '.join(OPTIONS)}; got some for {', '.join(candidates)}")
    values: dict[str, list[Any]] = {name: [] for name in OPTIONS}
    for name, settings in candidates.items():
        try:
            values[name] = [tuple(map(float, value)) if name == "windows" else float(value) for value in settings]
        except (TypeError, ValueError):
            raise InputError(
                f"expected candidates for {name} like {[getattr(given.greedy, name)]}; got {settings}"
            ) from None
        for value in values[name]:
            given.but(**{name: value})  # which refuses what is out of range
    return values
