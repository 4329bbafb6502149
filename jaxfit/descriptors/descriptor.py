"""The seam for descriptors: what the cascade asks of one."""

from functools import partial
from typing import Any, Protocol, runtime_checkable

from jax import lax
from jaxtyping import Array, Float, Int

from jaxfit.image.frame import Frame
from jaxfit.types import Crop, Features, Point, Scalar


@runtime_checkable
class Descriptor(Protocol):
    """Describes a landmark's neighbourhood; immutable and hashable, so that it can be part of a compiled function.

    It is a frozen dataclass whose fields are values of JSON, as model files and experiments write them, all with
    defaults; one of them is ``orientation``, which may be ``"upright"`` or ``"face"``, as the command line sets it.
    """

    @property
    def frame(self) -> Frame:
        """The crops that suit it."""
        ...

    @property
    def size(self) -> int:
        """Length of one landmark's vector."""
        ...

    @property
    def turns(self) -> bool:
        """Whether the window turns with the face: the cascade then works in a frame that is upright for the face."""
        ...

    @property
    def levels(self) -> int:
        """At how many resolutions it looks."""
        ...

    def level(self, window: Scalar) -> Int[Array, ""]:
        """At which of them, from 0, windows are looked at that measure ``window`` pixels on a face of scale 1."""
        ...

    def prepare(self, crop: Crop) -> Any:
        """What is computed once per face, whatever the number of landmarks, steps and initialisations."""
        ...

    def aim(self, prepared: Any, level: int, point: Point, side: Scalar, angle: Scalar) -> Any:
        """Where `describe` looks for one landmark at ``point``, in a window of ``side`` pixels.

        ``angle``, in radians, clockwise as seen, is that of the face; a window that does not turn ignores it. Apart
        from `describe`, as this is soonest done for all landmarks of a batch together, and that for one face after
        the other.
        """
        ...

    def describe(self, prepared: Any, level: int, aim: Any, angle: Scalar) -> Float[Array, "cells bins"]:
        """The histograms of one landmark."""
        ...

    def normalise(self, histograms: Float[Array, "cells bins"]) -> Features:
        """The histograms as the landmark's vector."""
        ...


def describe_point(descriptor: Descriptor, prepared: Any, point: Point, side: Scalar, angle: Scalar) -> Features:
    """The vector of one landmark of a face of scale 1; arguments are those of `Descriptor.aim`."""

    def at(level: int) -> Features:
        aim = descriptor.aim(prepared, level, point, side, angle)
        return descriptor.normalise(descriptor.describe(prepared, level, aim, angle))

    return lax.switch(descriptor.level(side), [partial(at, level) for level in range(descriptor.levels)])
