"""Cross-validated comparisons of methods, on any faces: configuration, tasks that can be resumed, results, report."""

from jaxfit.experiments.comparison import build_comparison, comparison_tables
from jaxfit.experiments.config import Config, DatasetPlan, MethodPlan, PosePlan, config_from, read_config
from jaxfit.experiments.experiment import Experiment
from jaxfit.experiments.figures import plot_fits, plot_grid, plot_starts
from jaxfit.experiments.report import build_report, write_report
from jaxfit.experiments.results import DatasetResults, ExperimentResults, PoseResults, read_results
from jaxfit.experiments.runner import Status, experiment_status, run_experiment
from jaxfit.experiments.tasks import Task, plan_tasks
from jaxfit.experiments.thesis.claims import Claim, thesis_claims

__all__ = [
    "Claim",
    "Config",
    "DatasetPlan",
    "DatasetResults",
    "Experiment",
    "ExperimentResults",
    "MethodPlan",
    "PosePlan",
    "PoseResults",
    "Status",
    "Task",
    "build_comparison",
    "build_report",
    "comparison_tables",
    "config_from",
    "experiment_status",
    "plan_tasks",
    "plot_fits",
    "plot_grid",
    "plot_starts",
    "read_config",
    "read_results",
    "run_experiment",
    "thesis_claims",
    "write_report",
]
