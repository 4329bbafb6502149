"""Learning models from labelled faces: greedy training, fine-tuning, choosing options, confidence, kinds of boxes."""

from jaxfit.learning.choose import Choice, Chosen, choose_options
from jaxfit.learning.confidence import SampledFits, learn_confidence, sample_fits
from jaxfit.learning.finetune import Finetuned, finetune
from jaxfit.learning.held_out import evaluate_held_out
from jaxfit.learning.methods import METHODS, Method, Options, options_for
from jaxfit.learning.placements import Calibrated, calibrate_boxes
from jaxfit.learning.suggest import Suggested, suggest
from jaxfit.learning.train import Trained, train
from jaxfit.processes import join_processes

__all__ = [
    "METHODS",
    "Calibrated",
    "Choice",
    "Chosen",
    "Finetuned",
    "Method",
    "Options",
    "SampledFits",
    "Suggested",
    "Trained",
    "calibrate_boxes",
    "choose_options",
    "evaluate_held_out",
    "finetune",
    "join_processes",
    "learn_confidence",
    "options_for",
    "sample_fits",
    "suggest",
    "train",
]
