"""The thesis's claims, each held against what an experiment measured."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from jaxfit.evaluation.pose import pose_errors
from jaxfit.evaluation.statistics import (
    both_measured,
    holm,
    rank_sum,
    relative_difference,
    signed_rank,
    subject_means,
    summarise,
)
from jaxfit.experiments.config import Config, MethodPlan
from jaxfit.experiments.results import DatasetResults, ExperimentResults, PoseResults
from jaxfit.shapes.camera import ANGLES

_ALPHA = 0.05
# The share of the whole improvement that must be reached where errors are said to level off.
_LEVEL = 0.9
_LEVEL_AUGMENTATIONS, _LEVEL_STEPS, _FEW_STARTS = 10, 5, 3
# By how much mean errors that are about equal may differ, and how many times as large an error means failure.
_ABOUT, _FAILING = 0.05, 2.0
_FRONTAL = 45
_ROUNDING = 5  # digits
_EQUAL = f"95 % interval of the difference within ±{_ABOUT:.0%}"


@dataclass(frozen=True)
class Claim:
    """A claim of the thesis, held against one set of faces.

    Attributes:
        letter: identifies the claim.
        claim: what the thesis says.
        where: what it was measured on.
        as_claimed: whether the figures are as claimed, whatever chance may have added.
        sure: whether an interval shows that errors claimed to be equal are equal; True for other claims.
        found: the figures.
        test: what ``p`` is of, or what decides instead of a test.
        p: two-sided p-value; None where errors are claimed to be equal, which no p-value can show.
        adjusted: ``p`` adjusted for all tests of the claim (Holm).
    """

    letter: str
    claim: str
    where: str
    as_claimed: bool
    found: str
    test: str
    p: float | None
    adjusted: float | None = None
    sure: bool = True

    @property
    def holds(self) -> bool:
        """Whether the claim holds here: the figures are as claimed, and that is more than chance."""
        return self.as_claimed and self.sure and (self.adjusted is None or self.adjusted < _ALPHA)

    @property
    def verdict(self) -> str:
        """Whether the claim holds, in words."""
        return "holds" if self.holds else "not shown" if self.as_claimed else "does not hold"


def thesis_claims(results: ExperimentResults) -> list[Claim]:
    """Every claim of the thesis that something was measured for, on each set of faces.

    p-values are adjusted for the number of tests that a claim has (Holm).
    """
    found = [
        *(claim for dataset in results.datasets for claim in _of_dataset(dataset, results.config)),
        *(claim for pose in results.pose for claim in _of_pose(pose, results.config)),
    ]
    claims = []
    for _, group in groupby(sorted(found, key=lambda claim: claim.letter), key=lambda claim: claim.letter):
        same = list(group)
        adjusted = holm(np.array([np.nan if claim.p is None else claim.p for claim in same]))
        claims += [
            claim if claim.p is None else replace(claim, adjusted=float(p))
            for claim, p in zip(same, adjusted, strict=True)
        ]
    return claims


def _of_dataset(dataset: DatasetResults, config: Config) -> Iterator[Claim]:
    plans = [plan for plan in config.methods if np.isfinite(dataset.errors(plan.name, config)).any()]
    for plan in plans:
        yield from _levels_off(dataset, plan, config)
    named = {plan.method: plan.name for plan in reversed(plans)}
    if {"sdm", "parametric"} <= named.keys():
        yield _parametric_against_sdm(dataset, named, config)
        yield from _few_starts(dataset, named, config)
    if {"alignment3d", "regression3d"} <= named.keys():
        yield from _regression_against_alignment(dataset, named, config)


def _levels_off(dataset: DatasetResults, plan: MethodPlan, config: Config) -> Iterator[Claim]:
    """(a) Errors fall with augmentations and with steps and level off."""
    grid = dataset.grid[plan.name]
    chosen = config.augmentations.index(config.chosen_augmentations)
    order = np.argsort(config.augmentations)
    axes = (
        (
            "augmentations",
            np.take(config.augmentations, order),
            grid[config.chosen_steps - 1, order],
            _LEVEL_AUGMENTATIONS,
        ),
        ("steps", np.arange(1, config.steps + 1), grid[:, chosen], _LEVEL_STEPS),
    )
    for name, counts, errors, level in axes:
        run = np.isfinite(errors).any(1)
        fitted = np.isfinite(errors[run]).all(0)
        counts, errors = counts[run], errors[run][:, fitted]
        # The error at that number can only be judged where it was run, and fewer and more were run as well.
        if level not in counts[1:-1] or not errors.size:
            continue
        there = int(np.flatnonzero(counts == level)[0])
        means = errors.mean(1)
        whole = means[0] - means[-1]
        share = (means[0] - means[there]) / whole if whole > 0 else np.nan
        yield Claim(
            "a",
            f"errors fall with {name} and level off at about {level}",
            f"{dataset.name}, {plan.name}",
            bool(means[there] < means[0] and share >= _LEVEL),
            f"{means[0]:.4f} at {counts[0]}, {means[there]:.4f} at {counts[there]}, {means[-1]:.4f} at {counts[-1]}: "
            f"{share:.0%} of the fall by {counts[there]}",
            f"signed-rank, {counts[0]} against {counts[there]}",
            signed_rank(errors[0], errors[there], dataset.subjects[fitted]),
        )


def _parametric_against_sdm(dataset: DatasetResults, named: dict[str, str], config: Config) -> Claim:
    """(b) The parametric method is better on AFLW, and as good on LFPW."""
    sdm, parametric = (dataset.errors(named[method], config) for method in ("sdm", "parametric"))
    thesis_p = f"the thesis's rank-sum p {rank_sum(*both_measured(sdm, parametric)):.2g}"
    if dataset.thesis == "LFPW":
        about, sure, found = _about_equal(parametric, sdm, dataset)
        claim = "the parametric method is as good as SDM"
        found = f"mean error of parametric {found}; {thesis_p}"
        return Claim("b", claim, dataset.name, about, found, _EQUAL, None, sure=sure)
    medians = [summarise(errors).median for errors in both_measured(sdm, parametric)]
    return Claim(
        "b",
        "the parametric method is better than SDM",
        dataset.name,
        medians[1] < medians[0],
        f"medians: SDM {medians[0]:.4f}, parametric {medians[1]:.4f} ({medians[1] / medians[0] - 1:+.1%}); {thesis_p}",
        "signed-rank",
        signed_rank(sdm, parametric, dataset.subjects),
    )


def _few_starts(dataset: DatasetResults, named: dict[str, str], config: Config) -> Iterator[Claim]:
    """(c) The parametric method suffers less from few initialisations."""
    counts = config.initialisations
    if not {1, _FEW_STARTS} <= set(counts):
        return
    chosen = [counts.index(1), counts.index(_FEW_STARTS)]
    errors = np.stack([dataset.starts[named[method]][chosen] for method in ("sdm", "parametric")])
    fitted = np.isfinite(errors).all((0, 1))
    if not fitted.any():
        return
    (sdm_one, sdm_few), (one, few) = errors[..., fitted]
    ratios = sdm_few.mean() / sdm_one.mean(), few.mean() / one.mean()
    # Where the upright fit is kept, the difference is nothing but rounding.
    rises = np.round(sdm_few - sdm_one, _ROUNDING), np.round(few - one, _ROUNDING)
    yield Claim(
        "c",
        f"the parametric method is less sensitive to few initialisations ({_FEW_STARTS})",
        dataset.name,
        bool(ratios[1] < ratios[0]),
        f"mean error with {_FEW_STARTS} starts over that with 1: SDM {ratios[0]:.2f}, parametric {ratios[1]:.2f}",
        "signed-rank of the rises",
        signed_rank(*rises, dataset.subjects[fitted]),
    )


def _regression_against_alignment(dataset: DatasetResults, named: dict[str, str], config: Config) -> Iterator[Claim]:
    """(d) 3D regression is faster than alignment at about equal errors."""
    pair = [named[method] for method in ("alignment3d", "regression3d")]
    seconds = [dataset.seconds[name] for name in pair]
    if not all(len(each) for each in seconds):
        return
    alignment, regression = (dataset.errors(name, config) for name in pair)
    about, sure, found = _about_equal(regression, alignment, dataset)
    times = [float(np.median(each)) for each in seconds]
    yield Claim(
        "d",
        "3D regression is faster than 3D alignment at about equal error in 3D",
        dataset.name,
        times[1] < times[0] and about,
        f"{times[0] / times[1]:.2f} times as fast ({1000 * times[0]:.1f} and {1000 * times[1]:.1f} ms); mean error of "
        f"regression {found}",
        f"signed-rank of times; {_EQUAL}",
        signed_rank(*seconds),
        sure=sure,
    )


def _about_equal(errors: np.ndarray, baseline: np.ndarray, dataset: DatasetResults) -> tuple[bool, bool, str]:
    """Whether mean errors differ by little, whether that is sure, and by how much they differ."""
    difference, width = relative_difference(errors, baseline, dataset.subjects)
    low, high = difference - width, difference + width
    sure = bool(low >= -_ABOUT and high <= _ABOUT)
    return bool(abs(difference) <= _ABOUT), sure, f"{difference:+.1%} ({low:+.1%} to {high:+.1%})"


def _of_pose(pose: PoseResults, config: Config) -> Iterator[Claim]:
    errors = {name: np.abs(pose_errors(fitted, pose.truth)) for name, fitted in pose.fitted.items()}
    named = {config.method(name).method: name for name in reversed(list(pose.fitted))}
    if {"alignment3d", "regression3d"} <= named.keys():
        pair = [named[method] for method in ("alignment3d", "regression3d")]
        for angle in ("pitch", "yaw"):
            yield from _better_angle(pose, pair, angle, [errors[name][:, ANGLES.index(angle)] for name in pair])
    yaw = ANGLES.index("yaw")
    for name, of in errors.items():
        yield from _fails_beyond(pose, name, of[:, yaw], np.abs(pose.truth[:, yaw]))


def _better_angle(pose: PoseResults, pair: list[str], angle: str, errors: list[np.ndarray]) -> Iterator[Claim]:
    """(e) 3D regression has the better pose."""
    alignment, regression = errors
    fitted = np.isfinite(alignment) & np.isfinite(regression)
    if not fitted.any():
        return
    means = [float(each[fitted].mean()) for each in errors]
    thesis_p = f"the thesis's rank-sum p {rank_sum(alignment, regression):.2g}"
    yield Claim(
        "e",
        f"3D regression finds the better {angle}",
        pose.title,
        means[1] < means[0],
        f"mean absolute errors: {pair[0]} {means[0]:.1f}°, {pair[1]} {means[1]:.1f}°; {thesis_p}",
        "signed-rank of people's means",
        signed_rank(alignment, regression, pose.subjects),
    )


def _fails_beyond(pose: PoseResults, name: str, errors: np.ndarray, turned: np.ndarray) -> Iterator[Claim]:
    """(f) Methods fail where heads are turned far."""
    sides = [np.isfinite(errors) & where for where in (turned <= _FRONTAL, turned > _FRONTAL)]
    if not all(side.any() for side in sides):
        return
    means = [float(errors[side].mean()) for side in sides]
    # One person's errors on both sides are no less alike than those of two: the test errs towards no difference.
    people = (subject_means(errors[side], pose.subjects[side]) for side in sides)
    yield Claim(
        "f",
        f"methods fail where heads are turned by more than {_FRONTAL}°",
        f"{pose.title}, {name}",
        means[1] >= _FAILING * means[0],
        f"mean absolute yaw error {means[0]:.1f}° up to {_FRONTAL}°, {means[1]:.1f}° beyond",
        "rank-sum of people's means",
        rank_sum(*people),
    )
