"""Coordinate systems for faces: a vector of parameters to landmarks, for one face."""

from jaxfit.shapes.camera_asm import CameraASM
from jaxfit.shapes.points import PointSpace
from jaxfit.shapes.similarity import SimilarityASM

# What model files call the shape spaces; a new one is a line here, and one in ``jaxfit.learning.methods.METHODS``.
SPACES = {"points": PointSpace, "similarity-asm": SimilarityASM, "camera-asm": CameraASM}
