"""The thesis's experiments on anybody's data: configuration, cells that can be resumed, tables, figures, a report."""

from jaxfit.experiments.claims import Claim, claims
from jaxfit.experiments.config import Config, config_from, read_config
from jaxfit.experiments.report import write_report
from jaxfit.experiments.results import Results, read_results
from jaxfit.experiments.running import run

__all__ = ["Claim", "Config", "Results", "claims", "config_from", "read_config", "read_results", "run", "write_report"]
