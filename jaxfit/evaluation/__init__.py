"""How good fits are: errors, curves, statistics, calibration and plots."""

from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.evaluate import Evaluation, detected_boxes, evaluate, match_boxes, measure, start_boxes
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.plots import plot_ced, plot_descriptor, plot_modes
from jaxfit.evaluation.statistics import auc_ci, holm, rank_sum, signed_rank, summarise

__all__ = [
    "Evaluation",
    "auc_ci",
    "detected_boxes",
    "evaluate",
    "holm",
    "match_boxes",
    "measure",
    "nmed",
    "plot_ced",
    "plot_descriptor",
    "plot_modes",
    "rank_sum",
    "signed_rank",
    "split_by_subject",
    "start_boxes",
    "summarise",
]
