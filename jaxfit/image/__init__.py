"""Pixels: smoothing, bilinear sampling, warps and disturbances; pure JAX, for one picture."""
