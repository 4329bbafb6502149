"""Many pictures: folders that resume, collections on a cluster, and workers of any kind."""

from jaxfit.runs.collection import fit_collection
from jaxfit.runs.folder import FolderReport, FolderRun, fit_folder
from jaxfit.runs.workers import BatchFitter

__all__ = ["BatchFitter", "FolderReport", "FolderRun", "fit_collection", "fit_folder"]
