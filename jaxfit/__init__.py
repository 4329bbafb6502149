"""jaxfit: face landmarks, 3D shape and head pose by cascaded regression, vectorised in JAX.

>>> model = jaxfit.load("face68")
>>> fits = jaxfit.fit(model, images)
>>> fits.landmarks  # (N, 68, 2), in the pixels of each image
>>> heads = jaxfit.fit(jaxfit.with_heads(model), images)
>>> heads.pose  # (N, 3): roll, pitch and yaw in degrees

What most people need is here; the rest lies in namespaces: ``jaxfit.cascade`` (the jitted functions inside),
``jaxfit.data`` (pictures, boxes, overlays, detectors), ``jaxfit.errors``, ``jaxfit.evaluation``, ``jaxfit.export``,
``jaxfit.fitting``, ``jaxfit.heads`` (3D head models), ``jaxfit.labels`` (labelled faces), ``jaxfit.learning``,
``jaxfit.models``, ``jaxfit.runs`` (folders, collections, workers), ``jaxfit.schemes`` and ``jaxfit.experiments``.
"""

__version__ = "0.2.0"

from jaxfit.environment import require_importable_jax

require_importable_jax()

# ruff: noqa: E402 - what imports JAX comes after it
from jaxfit import cascade, data, errors, evaluation, fitting, heads, labels, learning, models, runs, schemes
from jaxfit.cascade import Greedy, Starts, Tuning
from jaxfit.data import (
    FieldOfView,
    PinholeCamera,
    Search,
    detect_faces,
    draw_head,
    draw_landmarks,
    read_image,
    sample,
)
from jaxfit.errors import InputError, JaxfitError
from jaxfit.evaluation import Evaluation, evaluate
from jaxfit.fitting import Fits, Fitting, Placing, crop_faces, export, fit, fuse, place_heads, refine, track, warm_up
from jaxfit.heads import with_heads
from jaxfit.labels import read_dataset
from jaxfit.learning import Options, finetune, train
from jaxfit.models import Model, bundled, load, save
from jaxfit.runs import FolderRun, fit_folder

__all__ = [
    "Evaluation",
    "FieldOfView",
    "Fits",
    "Fitting",
    "FolderRun",
    "Greedy",
    "InputError",
    "JaxfitError",
    "Model",
    "Options",
    "PinholeCamera",
    "Placing",
    "Search",
    "Starts",
    "Tuning",
    "bundled",
    "cascade",
    "crop_faces",
    "data",
    "detect_faces",
    "draw_head",
    "draw_landmarks",
    "errors",
    "evaluate",
    "evaluation",
    "export",
    "finetune",
    "fit",
    "fit_folder",
    "fitting",
    "fuse",
    "heads",
    "labels",
    "learning",
    "load",
    "models",
    "place_heads",
    "read_dataset",
    "read_image",
    "refine",
    "runs",
    "sample",
    "save",
    "schemes",
    "track",
    "train",
    "warm_up",
    "with_heads",
]
