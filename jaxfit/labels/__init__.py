"""Labelled faces: records, the datasets that they are read from, and labels carried over from other schemes."""

from jaxfit.labels.aligned import AlignedHeads, align_labels
from jaxfit.labels.datasets import FORMATS, convert_dataset, read_dataset
from jaxfit.labels.gather import LabelledFaces, gather_faces
from jaxfit.labels.lifting import Lifted, fill_labels, lift_labels, share_labels
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.labels.writing import write_labels

__all__ = [
    "FORMATS",
    "AlignedHeads",
    "Dataset",
    "FaceRecord",
    "LabelledFaces",
    "Lifted",
    "align_labels",
    "convert_dataset",
    "fill_labels",
    "gather_faces",
    "lift_labels",
    "read_dataset",
    "share_labels",
    "write_labels",
]
