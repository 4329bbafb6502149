"""No detector at all: the picture is a face."""

from dataclasses import dataclass

import numpy as np

from jaxfit.data.detectors.detector import Detection

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

    def __call__(self, image: np.ndarray) -> list[Detection]:
        """The picture itself, as large as it is."""
        height, width = image.shape[:2]
        return [Detection(np.array([0.0, 0.0, width, height]), KIND)]
