"""Pixels: smoothing and bilinear sampling, in pure JAX, for one picture."""
