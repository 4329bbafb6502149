"""The thesis's claims, each held against what an experiment measured."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from jaxfit.evaluation.pose import ANGLES, pose_errors
from jaxfit.evaluation.statistics import both_measured, holm, rank_sum, signed_rank, summarise
from jaxfit.experiments.config import MethodPlan
from jaxfit.experiments.results import DatasetResults, PoseResults, Results

_ALPHA = 0.05
# How much of the whole improvement must be reached where errors are said to level off.
_LEVEL = 0.9
_LEVEL_AUGMENTATIONS, _LEVEL_STEPS, _FEW_STARTS = 10, 5, 3
# By how much errors may differ that are about equal, and times a worse error means failure.
_ABOUT, _FAILING = 0.05, 2.0
_FRONTAL = 45
_ROUNDING = 5  # digits


@dataclass(frozen=True)
class Claim:
    """A claim of the thesis, held against one set of faces.

    Attributes:
        letter: which one.
        claim: what the thesis says.
        where: what it was measured on.
        holds: whether it holds here.
        found: the figure.
        test: what ``p`` is of.
        p: two-sided p-value.
    """

    letter: str
    claim: str
    where: str
    holds: bool
    found: str
    test: str
    p: float


def claims(results: Results) -> list[tuple[Claim, float]]:
    """Every claim that something was measured for, and its p-value adjusted for how many there are (Holm)."""
    found = [
        *(claim for dataset in results.datasets for claim in _of_dataset(dataset, results)),
        *(claim for pose in results.pose for claim in _of_pose(pose)),
    ]
    found.sort(key=lambda claim: claim.letter)
    adjusted = holm(np.array([claim.p for claim in found]))
    return list(zip(found, map(float, adjusted), strict=True))


def _of_dataset(dataset: DatasetResults, results: Results) -> Iterator[Claim]:
    config = results.config
    plans = [plan for plan in config.methods if np.isfinite(dataset.errors(plan.name, config)).any()]
    for plan in plans:
        yield from _levels_off(dataset, plan, results)
    named = {plan.method: plan.name for plan in reversed(plans)}
    if {"sdm", "parametric"} <= named.keys():
        yield _parametric_against_sdm(dataset, named, results)
        yield from _few_starts(dataset, named, results)
    if {"alignment3d", "regression3d"} <= named.keys():
        yield from _regression_against_alignment(dataset, named, results)


def _levels_off(dataset: DatasetResults, plan: MethodPlan, results: Results) -> Iterator[Claim]:
    """(a) Errors fall with augmentations and with steps and level off."""
    config, grid = results.config, dataset.grid[plan.name]
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
        counts, errors = counts[run], errors[run]
        if len(counts) < 3 or counts[0] >= level or counts[-1] <= level:
            continue
        there = int(np.abs(counts - level).argmin())
        means = [summarise(each).mean for each in errors]
        p = signed_rank(errors[0], errors[there])
        whole = means[0] - means[-1]
        share = (means[0] - means[there]) / whole if whole > 0 else np.nan
        yield Claim(
            "a",
            f"errors fall with {name} and level off at about {level}",
            f"{dataset.name}, {plan.name}",
            means[there] < means[0] and p < _ALPHA and share >= _LEVEL,
            f"{means[0]:.4f} at {counts[0]}, {means[there]:.4f} at {counts[there]}, {means[-1]:.4f} at {counts[-1]}: "
            f"{share:.0%} of the fall by {counts[there]}",
            f"signed-rank, {counts[0]} against {counts[there]}",
            p,
        )


def _parametric_against_sdm(dataset: DatasetResults, named: dict[str, str], results: Results) -> Claim:
    """(b) The parametric method is better on AFLW, and as good on LFPW."""
    pair = (dataset.errors(named[method], results.config) for method in ("sdm", "parametric"))
    sdm, parametric = both_measured(*pair)
    p = rank_sum(sdm, parametric)
    medians = summarise(sdm).median, summarise(parametric).median
    equal = dataset.thesis == "LFPW"
    return Claim(
        "b",
        "the parametric method is as good as SDM" if equal else "the parametric method is better than SDM",
        dataset.name,
        p >= _ALPHA if equal else p < _ALPHA and medians[1] < medians[0],
        f"medians: SDM {medians[0]:.4f}, parametric {medians[1]:.4f} ({medians[1] / medians[0] - 1:+.1%}); "
        f"signed-rank p {signed_rank(sdm, parametric):.1e}",
        "rank-sum",
        p,
    )


def _few_starts(dataset: DatasetResults, named: dict[str, str], results: Results) -> Iterator[Claim]:
    """(c) The parametric method suffers less from few initialisations."""
    counts = results.config.initialisations
    if not {1, _FEW_STARTS} <= set(counts):
        return
    one, few = counts.index(1), counts.index(_FEW_STARTS)
    sdm, parametric = (dataset.starts[named[method]] for method in ("sdm", "parametric"))
    if not (np.isfinite(sdm[few]).any() and np.isfinite(parametric[few]).any()):
        return
    ratios = [summarise(errors[few]).mean / summarise(errors[one]).mean for errors in (sdm, parametric)]
    # Where the upright fit is kept, what is left is rounding.
    rises = (np.round(of[few] - of[one], _ROUNDING) for of in (sdm, parametric))
    p = signed_rank(*rises)
    yield Claim(
        "c",
        f"the parametric method is less sensitive to few initialisations ({_FEW_STARTS})",
        dataset.name,
        ratios[1] < ratios[0] and p < _ALPHA,
        f"mean error with {_FEW_STARTS} starts over that with 1: SDM {ratios[0]:.2f}, parametric {ratios[1]:.2f}",
        "signed-rank of the rises",
        p,
    )


def _regression_against_alignment(dataset: DatasetResults, named: dict[str, str], results: Results) -> Iterator[Claim]:
    """(d) 3D regression is faster than alignment at about equal errors."""
    alignment, regression = (named[method] for method in ("alignment3d", "regression3d"))
    pair = both_measured(*(dataset.errors(name, results.config) for name in (alignment, regression)))
    errors = [summarise(each).mean for each in pair]
    seconds = [dataset.seconds[name] for name in (alignment, regression)]
    if not all(len(each) for each in seconds):
        return
    times = [float(np.median(each)) for each in seconds]
    p = rank_sum(*seconds)
    yield Claim(
        "d",
        "3D regression is faster than 3D alignment at about equal error in 3D",
        dataset.name,
        times[1] < times[0] and p < _ALPHA and errors[1] <= (1 + _ABOUT) * errors[0],
        f"{times[0] / times[1]:.2f} times as fast ({1000 * times[0]:.1f} and {1000 * times[1]:.1f} ms); mean errors "
        f"{errors[0]:.4f} (alignment) and {errors[1]:.4f} ({errors[1] / errors[0] - 1:+.1%})",
        "rank-sum of times",
        p,
    )


def _of_pose(pose: PoseResults) -> Iterator[Claim]:
    errors = {name: np.abs(pose_errors(fitted, pose.truth)) for name, fitted in pose.fitted.items()}
    truth = pose.truth[:, ANGLES.index("yaw")]
    for angle in ("pitch", "yaw"):
        column = ANGLES.index(angle)
        for one, other in pairwise(sorted(errors)):
            p = rank_sum(errors[one][:, column], errors[other][:, column])
            means = [summarise(errors[name][:, column]).mean for name in (one, other)]
            yield Claim(
                "e",
                f"3D regression finds the better {angle}",
                pose.name,
                "regression" in other and means[1] < means[0] and p < _ALPHA,
                f"mean absolute errors: {one} {means[0]:.1f}°, {other} {means[1]:.1f}°",
                "rank-sum",
                p,
            )
    for name, of in errors.items():
        column = ANGLES.index("yaw")
        near = np.abs(truth) <= _FRONTAL
        means = [summarise(of[where, column]).mean for where in (near, ~near)]
        p = rank_sum(of[near, column], of[~near, column])
        yield Claim(
            "f",
            f"methods fail where heads are turned by more than {_FRONTAL}°",
            f"{pose.name}, {name}",
            means[1] >= _FAILING * means[0] and p < _ALPHA,
            f"mean absolute yaw error {means[0]:.1f}° up to {_FRONTAL}°, {means[1]:.1f}° beyond",
            "rank-sum",
            p,
        )
