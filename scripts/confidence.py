"""Measure, on people that a model did not learn from, whether the confidences of its fits are right.

With ``--report`` a plot is written beside the page, which needs matplotlib.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from report import Report, measure, save_figure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets, seed
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.errors import InputError
from jaxfit.evaluation.calibration import auroc, reliability
from jaxfit.evaluation.plots import new_figure, plot_reliability
from jaxfit.labels.datasets import read_datasets, shared_scheme
from jaxfit.learning.confidence import SampledFits, sample_fits
from jaxfit.learning.draw_starts import DETECTED, NO_FACES


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("model", metavar="MODEL", help="a model file, with a confidence")
    add_datasets(parser)
    parser.add_argument("--seed", type=seed, default=0, help="of the starts (default: 0)")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    model = jaxfit.load(arguments.model)
    datasets = read_datasets(arguments.data, arguments.scheme)
    if model.confidence is None or shared_scheme(datasets) != model.scheme:
        raise InputError(f"expected a model with a confidence, and labels as its own, {model.scheme.name}")
    faces = [face for dataset in datasets for face in dataset.faces if face.complete]
    with Bars() as bars:
        sampled = sample_fits(model, faces, seed=arguments.seed, progress=bars)
    report_problems(list(sampled.problems))
    add_figures(report, len(faces), sampled)
    if arguments.report:
        plot(Path(arguments.report).with_suffix(".png"), sampled)


def add_figures(report: Report, faces: int, sampled: SampledFits) -> None:
    """Add what the confidences of fits say, beside how good the fits are."""
    confidence, good, detected = sampled.confidence, sampled.good, sampled.starts == DETECTED
    no_face = np.isin(sampled.starts, NO_FACES) & ~good
    known = np.isfinite(confidence)
    rows = [
        {
            "fits": name,
            "number": int((of & known).sum()),
            "good": float(good[of & known].mean()),
            "AUROC": auroc(confidence[of & known], what[of & known]),
            "ECE": error and reliability(confidence[of & known], good[of & known]).error,
        }
        for name, of, what, error in (
            ("faces, or none", detected | no_face, detected, None),
            ("good or bad, of faces, in one pass", detected & (sampled.passes == 1), good, True),
            ("good or bad, of faces, in two passes", detected & (sampled.passes == 2), good, True),
            ("good or bad, all", np.ones_like(good), good, True),
        )
    ]
    kinds = [
        {
            "start": start,
            "number": int((sampled.starts == start).sum()),
            "good": float(good[sampled.starts == start].mean()),
            "mean confidence": float(np.nanmean(confidence[sampled.starts == start])),
            "ok": float((confidence[sampled.starts == start] >= 0.5).mean()),
        }
        for start in dict.fromkeys(sampled.starts.tolist())
    ]
    columns = {"fits": "", "number": "d", "good": ".3f", "AUROC": ".3f", "ECE": ".3f"}
    report.table(rows, columns, above=f"{faces} faces:")
    report.table(kinds, {"start": "", "number": "d", "good": ".3f", "mean confidence": ".3f", "ok": ".3f"})
    ok = detected & (confidence >= 0.5)
    report.add(
        f"Of faces in detectors' boxes, {good[ok].mean():.1%} of those that are `ok` are good, and "
        f"{ok[detected & good].mean():.1%}\nof the good ones are `ok`."
    )


def plot(path: Path, sampled: SampledFits) -> None:
    """Draw the share of good fits against their confidence; needs matplotlib."""
    detected = sampled.starts == DETECTED
    known = np.isfinite(sampled.confidence)
    figure = new_figure(5, 5)
    curves = {
        name: reliability(sampled.confidence[of & known], sampled.good[of & known])
        for name, of in (("faces", detected), ("all", np.ones_like(detected)))
    }
    ax = plot_reliability(curves, figure.subplots())
    ax.set(xlabel="confidence", ylabel="share of good fits")
    save_figure(figure, path, dpi=100)


if __name__ == "__main__":
    sys.exit(main())
