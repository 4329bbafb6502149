"""The host side: pictures, boxes, crops, videos, overlays; the only place that touches OpenCV and the disk."""

from jaxfit.data.boxes import read_boxes
from jaxfit.data.cameras import FieldOfView, PinholeCamera
from jaxfit.data.crops import Crops
from jaxfit.data.detectors import Detection, Detector, Search, detect_faces, detector_named
from jaxfit.data.limits import at_most_megapixels
from jaxfit.data.overlays import draw_head, draw_landmarks, draw_row
from jaxfit.data.pictures import find_images, read_image, write_image
from jaxfit.data.samples import sample
from jaxfit.data.videos import Video

__all__ = [
    "Crops",
    "Detection",
    "Detector",
    "FieldOfView",
    "PinholeCamera",
    "Search",
    "Video",
    "at_most_megapixels",
    "detect_faces",
    "detector_named",
    "draw_head",
    "draw_landmarks",
    "draw_row",
    "find_images",
    "read_boxes",
    "read_image",
    "sample",
    "write_image",
]
