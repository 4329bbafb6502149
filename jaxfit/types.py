"""The dimension vocabulary: every array type that more than one module names; and the type of progress callbacks.

Dimension names used throughout: ``height width`` (pixels, rows first), ``landmarks`` (points of one face), ``params``
(coordinates of one face in a shape space), ``features`` (the concatenated descriptors of one face), ``steps`` (of the
cascade), ``faces`` (a batch) and ``starts`` (initialisations of one face). Points are ``x`` right, ``y`` down, in
pixels, with pixel centres at integers; in 3D, ``z`` is away from the viewer, in the unit of ``x`` and ``y``; images
are indexed ``[row, column]``.
"""

from collections.abc import Callable

from jaxtyping import Array, Float, UInt8

Crop = UInt8[Array, "height width"]
Picture = Float[Array, "height width"]
Scalar = Float[Array, ""]
Point = Float[Array, "2"]
Landmarks = Float[Array, "landmarks 2"]
Landmarks3D = Float[Array, "landmarks 3"]
Rotation = Float[Array, "3 3"]
Params = Float[Array, "params"]
Features = Float[Array, "features"]

# Called with a stage's name, what is done and what there is to do.
Progress = Callable[[str, int, int], None]


def silent(stage: str, done: int, total: int) -> None:
    """Progress that is not shown."""
