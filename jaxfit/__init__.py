"""jaxfit: face landmarks by cascaded regression, vectorised in JAX."""
