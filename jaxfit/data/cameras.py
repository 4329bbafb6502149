"""Cameras whose numbers are known: how far their pictures' pixels lie from their axis, for one unit of depth."""

import math
from dataclasses import dataclass

from jaxfit.errors import InputError


@dataclass(frozen=True)
class PinholeCamera:
    """A camera without distortion, as OpenCV's calibration gives it: a point at X, Y, Z before it (x right, y down, z
    forward) is seen at fx · X / Z + cx, fy · Y / Z + cy.

    Attributes:
        fx: focal length in pixels, across.
        fy: focal length in pixels, down.
        cx: where the axis meets the picture, in pixels from the centre of the first one, across.
        cy: and down. All are of the picture turned upright as its EXIF data say.

    Raises:
        InputError: a number that is not finite, or a focal length that is not positive.
    """

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if not all(map(math.isfinite, numbers)) or min(self.fx, self.fy) <= 0:
            raise InputError(
                "expected a camera's focal lengths, above 0, and where its axis meets the picture, in pixels: fx fy cx "
                f"cy; got {' '.join(f'{number:g}' for number in numbers)}"
            )

    def of_size(self, width: int, height: int) -> "PinholeCamera":
        """The camera of pictures of a size, in pixels: itself."""
        return self


@dataclass(frozen=True)
class FieldOfView:
    """A camera of which only the field of view is known. Pixels are taken to be square, and the axis to meet the
    picture in its middle.

    Attributes:
        degrees: the angle that the width of the picture covers; about 60 for webcams, 70 for phones.

    Raises:
        InputError: no angle between 0 and 180 degrees.
    """

    degrees: float

    def __post_init__(self) -> None:
        if not 0 < self.degrees < 180:
            raise InputError(f"expected a field of view between 0 and 180 degrees; got {self.degrees:g}")

    def of_size(self, width: int, height: int) -> PinholeCamera:
        """The camera of pictures of a size, in pixels."""
        focal = width / 2 / math.tan(math.radians(self.degrees) / 2)
        return PinholeCamera(focal, focal, (width - 1) / 2, (height - 1) / 2)


Camera = PinholeCamera | FieldOfView
