"""The ``jaxfit`` command: thin layers over the Python API."""
