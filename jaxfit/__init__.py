"""jaxfit: face landmarks, 3D shape and head pose by cascaded regression, vectorised in JAX.

>>> model = jaxfit.load("face68")
>>> fits = jaxfit.fit(model, images)
>>> fits.landmarks  # (N, 68, 2), in the pixels of each image
>>> heads = jaxfit.fit(jaxfit.load("face68-3d"), images)
>>> heads.pose  # (N, 3): roll, pitch and yaw in degrees
"""

__version__ = "0.1.0"

from jaxfit.batching import BatchFitter
from jaxfit.calibrating import calibrate_boxes
from jaxfit.cascade.finetune import Tuning
from jaxfit.cascade.fit import Heads, fit_crops, fit_face, fit_heads
from jaxfit.choosing import Chosen, Trial, choose_options
from jaxfit.collecting import fit_collection
from jaxfit.cropping import crop_faces
from jaxfit.data.datasets import convert_dataset, read_dataset
from jaxfit.data.detectors import detect_faces
from jaxfit.data.images import read_image
from jaxfit.data.overlays import draw_head, draw_landmarks
from jaxfit.data.records import Dataset, FaceRecord
from jaxfit.data.videos import Video
from jaxfit.detecting import Found, find_faces
from jaxfit.evaluating import Evaluation, evaluate, start_boxes
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.exceptions import DatasetError, ImageError, InputError, JaxfitError, ModelError, ProcessError
from jaxfit.exporting import Exported, export_model, load_exported
from jaxfit.finetuning import Finetuned, finetune
from jaxfit.fitting import Fits, fit, warm_up
from jaxfit.fusing import fuse
from jaxfit.image.disturb import Disturbance
from jaxfit.lifting import Lifted, fill_labels, lift_labels, share_labels
from jaxfit.models.files import bundled, load, save
from jaxfit.models.heads import HeadModel, bundled_heads, load_head, save_head
from jaxfit.models.model import Model
from jaxfit.processes import join_processes
from jaxfit.smoothing import OneEuro
from jaxfit.tracking import TrackedFace, TrackedFrame, Tracker, track
from jaxfit.training import Options, Trained, train
from jaxfit.trusting import Trials, learn_confidence, try_fits

__all__ = [
    "BatchFitter",
    "Chosen",
    "Dataset",
    "DatasetError",
    "Disturbance",
    "Evaluation",
    "Exported",
    "FaceRecord",
    "Finetuned",
    "Fits",
    "Found",
    "HeadModel",
    "Heads",
    "ImageError",
    "InputError",
    "JaxfitError",
    "Lifted",
    "Model",
    "ModelError",
    "OneEuro",
    "Options",
    "ProcessError",
    "TrackedFace",
    "TrackedFrame",
    "Tracker",
    "Trained",
    "Trial",
    "Trials",
    "Tuning",
    "Video",
    "bundled",
    "bundled_heads",
    "calibrate_boxes",
    "choose_options",
    "convert_dataset",
    "crop_faces",
    "detect_faces",
    "draw_head",
    "draw_landmarks",
    "evaluate",
    "export_model",
    "fill_labels",
    "find_faces",
    "finetune",
    "fit",
    "fit_collection",
    "fit_crops",
    "fit_face",
    "fit_heads",
    "fuse",
    "join_processes",
    "learn_confidence",
    "lift_labels",
    "load",
    "load_exported",
    "load_head",
    "read_dataset",
    "read_image",
    "save",
    "save_head",
    "share_labels",
    "split_by_subject",
    "start_boxes",
    "track",
    "train",
    "try_fits",
    "warm_up",
]
