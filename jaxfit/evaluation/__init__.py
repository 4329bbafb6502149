"""How good fits are: errors, curves, statistics, calibration and plots."""

from jaxfit.evaluation.boxes import detected_boxes, match_boxes, start_boxes
from jaxfit.evaluation.datasets import EvaluationPlan, EvaluationRun, evaluation_report, plan_evaluation
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.evaluate import Evaluation, evaluate, measure
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.plots import plot_ced, plot_descriptor, plot_modes
from jaxfit.evaluation.statistics import auc_ci, holm, rank_sum, signed_rank, summarise

__all__ = [
    "Evaluation",
    "EvaluationPlan",
    "EvaluationRun",
    "auc_ci",
    "detected_boxes",
    "evaluate",
    "evaluation_report",
    "holm",
    "match_boxes",
    "measure",
    "nmed",
    "plan_evaluation",
    "plot_ced",
    "plot_descriptor",
    "plot_modes",
    "rank_sum",
    "signed_rank",
    "split_by_subject",
    "start_boxes",
    "summarise",
]
