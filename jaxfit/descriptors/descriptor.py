"""The seam for descriptors: what the cascade asks of one."""

from typing import Any, Protocol, runtime_checkable

from jaxfit.types import Crop, Features, Point, Scalar


@runtime_checkable
class Descriptor(Protocol):
    """Describes a landmark's neighbourhood; immutable and hashable, so that it can be part of a compiled function."""

    @property
    def size(self) -> int:
        """Length of one landmark's vector."""
        ...

    @property
    def turns(self) -> bool:
        """Whether the window turns with the face: the cascade then works in a frame that is upright for the face."""
        ...

    def prepare(self, crop: Crop) -> Any:
        """What is computed once per face, whatever the number of landmarks, steps and initialisations."""
        ...

    def describe(self, prepared: Any, point: Point, side: Scalar, angle: Scalar) -> Features:
        """The vector of one landmark at ``point``, in a window of ``side`` pixels.

        ``angle``, in radians, clockwise as seen, is that of the face; a window that does not turn ignores it.
        """
        ...
