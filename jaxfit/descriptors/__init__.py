"""What a landmark's neighbourhood looks like, as a vector; pure JAX, for one landmark."""
