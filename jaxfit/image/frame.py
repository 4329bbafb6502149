"""The size of the crops that everything on the device works on."""

from dataclasses import dataclass

from jaxfit.exceptions import InputError


@dataclass(frozen=True)
class Frame:
    """A square crop with a canonical face in its middle.

    Attributes:
        crop: side of the crop, in pixels.
        face: side of the canonical face (the bounding square of the mean face's landmarks), in pixels.
    """

    crop: int = 208
    face: float = 120.0

    def __post_init__(self) -> None:
        if not (8 <= self.face <= self.crop <= 4096):
            raise InputError(f"a crop needs 8 <= face <= crop <= 4096 pixels, got face {self.face}, crop {self.crop}")

    @property
    def middle(self) -> float:
        """Coordinate of the crop's centre, in pixels."""
        return (self.crop - 1) / 2
