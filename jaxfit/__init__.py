"""jaxfit: face landmarks by cascaded regression, vectorised in JAX.

>>> model = jaxfit.load("sdm68")
>>> fits = jaxfit.fit(model, images, boxes)
>>> fits.landmarks  # (N, 68, 2), in the pixels of each image
"""

__version__ = "0.1.0.dev0"

from jaxfit.cascade.fit import fit_crops, fit_face
from jaxfit.data.datasets import convert_dataset, read_dataset
from jaxfit.data.detection import detect_faces
from jaxfit.data.images import read_image
from jaxfit.evaluating import evaluate
from jaxfit.exceptions import DatasetError, ImageError, InputError, JaxfitError, ModelError
from jaxfit.fitting import Fits, crop_faces, fit, warm_up
from jaxfit.models.files import bundled, load, save
from jaxfit.models.model import Model
from jaxfit.training import Options, Trained, train

__all__ = [
    "DatasetError",
    "Fits",
    "ImageError",
    "InputError",
    "JaxfitError",
    "Model",
    "ModelError",
    "Options",
    "Trained",
    "bundled",
    "convert_dataset",
    "crop_faces",
    "detect_faces",
    "evaluate",
    "fit",
    "fit_crops",
    "fit_face",
    "load",
    "read_dataset",
    "read_image",
    "save",
    "train",
    "warm_up",
]
