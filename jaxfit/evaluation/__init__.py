"""How good fits are: errors, curves, statistics, calibration and plots."""

from jaxfit.evaluation.boxes import detected_boxes, match_boxes, start_boxes
from jaxfit.evaluation.compare import (
    Comparison,
    ComparisonPlan,
    Contestant,
    Entry,
    plan_comparison,
    read_contestants,
)
from jaxfit.evaluation.datasets import EvaluationPlan, EvaluationRun, evaluation_report, plan_evaluation
from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.evaluate import Evaluation, evaluate, measure
from jaxfit.evaluation.fit_files import FoundFaces, read_fits
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.plots import plot_by_yaw, plot_ced, plot_descriptor, plot_modes
from jaxfit.evaluation.protocols import PROTOCOLS, Protocol
from jaxfit.evaluation.statistics import (
    Intervals,
    auc_ci,
    holm,
    intervals,
    median_ci,
    rank_biserial,
    rank_sum,
    signed_rank,
    summarise,
)

__all__ = [
    "PROTOCOLS",
    "Comparison",
    "ComparisonPlan",
    "Contestant",
    "Entry",
    "Evaluation",
    "EvaluationPlan",
    "EvaluationRun",
    "FoundFaces",
    "Intervals",
    "Protocol",
    "auc_ci",
    "detected_boxes",
    "evaluate",
    "evaluation_report",
    "holm",
    "intervals",
    "match_boxes",
    "measure",
    "median_ci",
    "nmed",
    "plan_comparison",
    "plan_evaluation",
    "plot_by_yaw",
    "plot_ced",
    "plot_descriptor",
    "plot_modes",
    "rank_biserial",
    "rank_sum",
    "read_contestants",
    "read_fits",
    "signed_rank",
    "split_by_subject",
    "start_boxes",
    "summarise",
]
