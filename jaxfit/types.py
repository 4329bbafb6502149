"""The dimension vocabulary: every array type that more than one module names.

Dimension names used throughout: ``height width`` (pixels, rows first), ``landmarks`` (points of one face), ``params``
(coordinates of one face in a shape space), ``features`` (the concatenated descriptors of one face), ``steps`` (of the
cascade), ``faces`` (a batch) and ``starts`` (initialisations of one face). Points are ``x`` right, ``y`` down, in
pixels, with pixel centres at integers; in 3D, ``z`` is away from the viewer, in the unit of ``x`` and ``y``; images
are indexed ``[row, column]``.
"""

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
