"""Coordinate systems for faces, and what their landmarks mean."""
