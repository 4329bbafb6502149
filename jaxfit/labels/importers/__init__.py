"""Readers of labelled datasets, one a file; `jaxfit.labels.datasets.FORMATS` lists them by name."""
