"""Figures of an evaluation; needs matplotlib, the optional extra ``plots``."""

from typing import TYPE_CHECKING

import numpy as np

from jaxfit.evaluation.curves import LIMIT, auc, ced
from jaxfit.exceptions import InputError

if TYPE_CHECKING:
    import matplotlib.axes


def plot_ced(
    errors_by_name: dict[str, np.ndarray],
    limit: float = LIMIT,
    ax: "matplotlib.axes.Axes | None" = None,
) -> "matplotlib.axes.Axes":
    """CED curves from 0 to ``limit``, with the area under each in the legend.

    Args:
        errors_by_name: (N,) normalised errors of each method; ``inf`` is a failed fit, NaN is left out.
        limit: where the curves end, in the units of the errors.
        ax: where to draw; a new figure if None.

    Returns:
        The axes drawn on.

    Raises:
        InputError: matplotlib is missing, errors are not a vector, or the limit is not positive.
    """
    thresholds = np.linspace(0.0, limit, 501)
    curves = {
        f"{name} (AUC {auc(errors, limit):.3f})": ced(errors, thresholds) for name, errors in errors_by_name.items()
    }
    ax = ax if ax is not None else _new_axes()
    for label, shares in curves.items():
        ax.plot(thresholds, shares, label=label)
    ax.set(xlim=(0.0, limit), ylim=(0.0, 1.0), xlabel="NMED", ylabel="share of faces")
    ax.grid(alpha=0.3)
    if curves:
        ax.legend(loc="lower right")
    return ax


def _new_axes() -> "matplotlib.axes.Axes":
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise InputError('plots need matplotlib: pip install "jaxfit[plots]"') from error
    return plt.subplots()[1]
