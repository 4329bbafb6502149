"""The CED figure shows the curves it was given, and says what to install when it cannot."""

import sys
from collections.abc import Iterator

import numpy as np
import pytest

from jaxfit.evaluation.curves import ced
from jaxfit.evaluation.plots import plot_ced
from jaxfit.exceptions import InputError

ERRORS = {"SDM": np.array([0.02, 0.04, np.inf]), "parametric": np.array([0.01, 0.03, np.nan])}


@pytest.fixture
def pyplot() -> Iterator:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    yield plt
    plt.close("all")


def test_curves_labels_and_legend(pyplot) -> None:
    axes = plot_ced(ERRORS, limit=0.05)
    assert axes.get_xlabel()
    assert axes.get_ylabel()
    assert axes.get_xlim() == (0.0, 0.05)
    for line, errors in zip(axes.get_lines(), ERRORS.values(), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), ced(errors, np.asarray(line.get_xdata())))
    entries = [text.get_text() for text in axes.get_legend().get_texts()]
    assert entries == ["SDM (AUC 0.267)", "parametric (AUC 0.600)"]
    axes.figure.canvas.draw()


def test_draws_on_given_axes(pyplot) -> None:
    axes = pyplot.subplots()[1]
    assert plot_ced(ERRORS, ax=axes) is axes


def test_methods_of_one_name_and_score_are_kept_apart_by_name(pyplot) -> None:
    same = np.array([0.01])
    assert len(plot_ced({"a": same, "b": same}).get_lines()) == 2


def test_nothing_to_plot(pyplot) -> None:
    assert plot_ced({}).get_legend() is None


def test_without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(InputError, match=r'pip install "jaxfit\[plots\]"'):
        plot_ced(ERRORS)
