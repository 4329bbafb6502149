"""The crops that everything on the device works on: their size, and where labels lie in them."""

from dataclasses import dataclass

from jaxfit.errors import InputError

_MOST_SHIFT = 10.0


@dataclass(frozen=True)
class Frame:
    """A square crop with a canonical face in its middle.

    Attributes:
        crop: side of the crop, in pixels.
        face: side of the canonical face (the bounding square of the mean face's landmarks), in pixels.
        shift: picture pixels by which labels lie right of and below what they mark, and fits like them. In mirrored
            pictures they would lie to the left of it, so that it must be known. ``scripts/label_shift.py`` measures it.
    """

    crop: int = 208
    face: float = 120.0
    shift: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.crop, int) or isinstance(self.crop, bool):
            raise InputError(f"expected a whole number of pixels for the side of a crop; got {self.crop!r}")
        if not abs(self.shift) <= _MOST_SHIFT:
            raise InputError(f"expected labels that are off by up to {_MOST_SHIFT} pixels; got a shift of {self.shift}")
        if not (8 <= self.face <= self.crop <= 4096):
            raise InputError(f"a crop needs 8 <= face <= crop <= 4096 pixels, got face {self.face}, crop {self.crop}")

    @property
    def middle(self) -> float:
        """Coordinate of the crop's centre, in pixels."""
        return (self.crop - 1) / 2
