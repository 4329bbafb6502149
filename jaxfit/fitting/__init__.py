"""Fitting pictures: one stream from files or arrays to fits, and what is done with several fits, videos and exports."""

from jaxfit.fitting.crop import crop_faces
from jaxfit.fitting.find import Found, find_faces
from jaxfit.fitting.fit import fit, warm_up
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.fitting.fuse import fuse
from jaxfit.fitting.one_euro import OneEuro
from jaxfit.fitting.pipeline import Fitting, Pipeline
from jaxfit.fitting.place import Placing, place_heads
from jaxfit.fitting.refine import refine
from jaxfit.fitting.sources import Source
from jaxfit.fitting.stream import stream
from jaxfit.fitting.track import TrackedFrame, Tracker, track

__all__ = [
    "Fits",
    "Fitting",
    "Found",
    "OneEuro",
    "Pipeline",
    "Placing",
    "Problem",
    "Source",
    "TrackedFrame",
    "Tracker",
    "crop_faces",
    "find_faces",
    "fit",
    "fuse",
    "place_heads",
    "refine",
    "stream",
    "track",
    "warm_up",
]
