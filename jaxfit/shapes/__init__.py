"""Coordinate systems for faces, and what their landmarks mean."""

from jaxfit.shapes.points import PointSpace

# What model files call the shape spaces; a new one is a line here, and one in ``jaxfit.training.METHODS``.
SPACES = {"points": PointSpace}
