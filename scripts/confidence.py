"""Measure on people that a model did not learn from whether what it says of its fits (fits.confidence) is true."""

import argparse
import sys
from pathlib import Path

import numpy as np
from compare_models import write_report

import jaxfit
from jaxfit.cli.arguments import add_datasets, read_datasets, seed, shared_scheme
from jaxfit.cli.main import exit_code
from jaxfit.cli.progress import Bars
from jaxfit.data.outputs import atomic_write
from jaxfit.errors import InputError
from jaxfit.evaluation.calibration import auroc, reliability
from jaxfit.evaluation.plots import new_figure, plot_reliability
from jaxfit.evaluation.tables import markdown_table
from jaxfit.learning.confidence import DETECTED, NO_FACES, Trials, try_fits


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", metavar="MODEL", help="a model file, with a confidence")
    add_datasets(parser)
    parser.add_argument("--seed", type=seed, default=0, help="of the starts (default: 0)")
    parser.add_argument(
        "--report", metavar="FILE.md", help="replace the figures in this page, and the plot beside it; needs matplotlib"
    )
    return exit_code(run, parser.parse_args())


def run(arguments: argparse.Namespace) -> int:
    model = jaxfit.load(arguments.model)
    datasets = read_datasets(arguments.data, arguments.scheme)
    if model.confidence is None or shared_scheme(datasets) != model.scheme:
        raise InputError(f"expected a model with a confidence, and labels as its own, {model.scheme.name}")
    faces = [face for dataset in datasets for face in dataset.faces if face.complete]
    with Bars() as bars:
        trials = try_fits(model, faces, seed=arguments.seed, progress=bars)
    text = told_of(len(faces), trials)
    print(text)
    if arguments.report:
        page = Path(arguments.report)
        write_report(page, [text])
        plot(page.with_suffix(".png"), trials)
    return 0


def told_of(faces: int, trials: Trials) -> str:
    """The figures: Markdown."""
    told, good, detected = trials.confidence, trials.good, trials.starts == DETECTED
    nothing = np.isin(trials.starts, NO_FACES) & ~good
    seen = detected | nothing
    known = np.isfinite(told)
    rows = [
        {
            "fits": name,
            "number": int((of & known).sum()),
            "good": float(good[of & known].mean()),
            "AUROC": auroc(told[of & known], what[of & known]),
            "ECE": error and reliability(told[of & known], good[of & known]).error,
        }
        for name, of, what, error in (
            ("faces, or none", seen, detected, None),
            ("good or bad, of faces, in one pass", detected & (trials.passes == 1), good, True),
            ("good or bad, of faces, in two passes", detected & (trials.passes == 2), good, True),
            ("good or bad, all", np.ones_like(good), good, True),
        )
    ]
    kinds = [
        {
            "start": start,
            "number": int((trials.starts == start).sum()),
            "good": float(good[trials.starts == start].mean()),
            "mean confidence": float(np.nanmean(told[trials.starts == start])),
            "ok": float((told[trials.starts == start] >= 0.5).mean()),
        }
        for start in dict.fromkeys(trials.starts.tolist())
    ]
    ok = detected & (told >= 0.5)
    good_ok = float(good[ok].mean())
    columns = {"fits": "", "number": "d", "good": ".3f", "AUROC": ".3f", "ECE": ".3f"}
    of_starts = {"start": "", "number": "d", "good": ".3f", "mean confidence": ".3f", "ok": ".3f"}
    return f"""{faces} faces:

{markdown_table(rows, columns)}

{markdown_table(kinds, of_starts)}

Of faces in detectors' boxes, {good_ok:.1%} of those that are `ok` are good, and {float(ok[detected & good].mean()):.1%}
of the good ones are `ok`.
"""


def plot(path: Path, trials: Trials) -> None:
    """Draw how many fits are good beside what was said of them."""
    detected = trials.starts == DETECTED
    known = np.isfinite(trials.confidence)
    figure = new_figure(5, 5)
    curves = {
        name: reliability(trials.confidence[of & known], trials.good[of & known])
        for name, of in (("faces", detected), ("all", np.ones_like(detected)))
    }
    ax = plot_reliability(curves, figure.subplots())
    ax.set(xlabel="confidence", ylabel="share of good fits")
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=100)


if __name__ == "__main__":
    sys.exit(main())
