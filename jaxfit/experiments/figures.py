"""Figures of an experiment: errors over the grid and over initialisations, and fitted faces.

They are matplotlib's own objects that pyplot does not know: notebooks show them as the last expression of a cell.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxfit.evaluation.plots import draw_face, new_figure, pyplot
from jaxfit.evaluation.statistics import Subjects, summarise
from jaxfit.schemes.scheme import Scheme

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure

TRUTH, FIT = "red", "cyan"


def mean_and_ci(errors: np.ndarray, subjects: Subjects = None) -> tuple[np.ndarray, np.ndarray]:
    """Means (...) of errors (..., N) over fitted faces, and half the widths of their 95 % confidence intervals.

    ``subjects`` say whose each of the N faces is, as in ``summarise``.
    """
    summaries = [summarise(each, subjects=subjects) for each in errors.reshape(-1, errors.shape[-1])]
    shape = errors.shape[:-1]
    return (
        np.array([summary.mean for summary in summaries]).reshape(shape),
        np.array([summary.ci95 for summary in summaries]).reshape(shape),
    )


def plot_grid(
    grids: Mapping[str, np.ndarray], augmentations: Sequence[int], error: str = "NMED", subjects: Subjects = None
) -> "matplotlib.figure.Figure":
    """Mean errors and their 95 % confidence intervals over steps, a panel a method.

    Args:
        grids: by method, (steps, augmentations, N) errors.
        augmentations: of the second axis; a line each.
        error: what is measured.
        subjects: whose each of the N faces is.
    """
    figure = new_figure(5.2 * len(grids), 4.0)
    axes = figure.subplots(1, len(grids), sharey=True, squeeze=False)
    colours = pyplot().colormaps["viridis"](np.linspace(0.05, 0.85, len(augmentations)))
    for ax, (name, errors) in zip(axes[0], grids.items(), strict=True):
        means, widths = mean_and_ci(errors, subjects)
        steps = np.arange(1, len(errors) + 1)
        for column, count in enumerate(augmentations):
            mean, width = means[:, column], widths[:, column]
            ax.plot(steps, mean, ".-", color=colours[column], label=str(count))
            ax.fill_between(steps, mean - width, mean + width, color=colours[column], alpha=0.12, linewidth=0)
        ax.set(xlabel="steps", title=name, xticks=steps)
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel(f"mean {error}")
    axes[0, -1].legend(title="augmentations")
    return figure


def plot_starts(
    starts: Mapping[str, np.ndarray],
    counts: Sequence[int],
    error: str = "NMED",
    subjects: Subjects = None,
) -> "matplotlib.figure.Figure":
    """Mean errors and their 95 % confidence intervals over the number of initialisations.

    Args:
        starts: by method, (initialisations, N) errors.
        counts: of the first axis.
        error: what is measured.
        subjects: whose each of the N faces is.
    """
    figure = new_figure(6.5, 4.0)
    ax = figure.subplots()
    for number, (name, errors) in enumerate(starts.items()):
        mean, width = mean_and_ci(errors, subjects)
        ax.errorbar(counts, mean, width, fmt="o-", capsize=3, color=f"C{number}", label=name)
    ax.set(xlabel="initialisations", ylabel=f"mean {error}", xticks=counts)
    ax.grid(alpha=0.3)
    ax.legend()
    return figure


def plot_fits(
    pictures: Sequence[np.ndarray | None],
    truths: Sequence[np.ndarray],
    fits: Mapping[str, Sequence[np.ndarray]],
    titles: Sequence[str],
    scheme: Scheme,
    side: int,
) -> "matplotlib.figure.Figure":
    """Fitted faces, a row a method: labels in red and fits in cyan.

    Args:
        pictures: F square pictures, uint8 (side, side) or (side, side, 3); None for an empty ground.
        truths: their labels (L, 2), in pixels of the pictures.
        fits: by method, what was found.
        titles: of the columns.
        scheme: which points lines join.
        side: of the pictures, in pixels.
    """
    shape = (len(fits), len(pictures))
    figure = new_figure(1.7 * shape[1] + 0.4, 1.8 * shape[0] + 0.3)
    axes = figure.subplots(*shape, squeeze=False)
    for row, (name, found) in zip(axes, fits.items(), strict=True):
        row[0].set_ylabel(name)
        for ax, picture, truth, fit in zip(row, pictures, truths, found, strict=True):
            if picture is not None:
                ax.imshow(picture, cmap="gray", vmin=0, vmax=255)
            draw_face(ax, truth, scheme, TRUTH)
            draw_face(ax, fit, scheme, FIT)
            ax.set(xlim=(0, side), ylim=(side, 0), aspect="equal", xticks=[], yticks=[])
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=9)
    return figure
