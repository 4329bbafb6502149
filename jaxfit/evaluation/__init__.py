"""How good fits are: errors, curves, statistics, calibration and plots."""

from jaxfit.evaluation.errors import nmed
from jaxfit.evaluation.evaluate import Evaluation, detected_boxes, evaluate, match_boxes, measure, start_boxes
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.statistics import signed_rank, summarise

__all__ = [
    "Evaluation",
    "detected_boxes",
    "evaluate",
    "match_boxes",
    "measure",
    "nmed",
    "signed_rank",
    "split_by_subject",
    "start_boxes",
    "summarise",
]
