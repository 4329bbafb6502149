"""No detector at all: the picture is a face."""

from dataclasses import dataclass

import numpy as np

from jaxfit.data.detectors.detector import Detection
from jaxfit.data.pictures import Pixels, to_eight_bits

KIND = "whole"


@dataclass(frozen=True)
class Whole:
    """For pictures that somebody has cut around faces."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """One."""
        return (KIND,)

    @property
    def colour(self) -> bool:
        """No: it does not look at all."""
        return False

    @property
    def rough(self) -> bool:
        """Yes: a second pass saves failures, as ``scripts/detectors.py`` measures."""
        return True

    def __call__(self, image: Pixels) -> list[Detection]:
        """The picture itself, as large as it is."""
        height, width = to_eight_bits(image).shape[:2]
        return [Detection(np.array([0.0, 0.0, width, height]), KIND)]
