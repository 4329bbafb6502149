"""dlib's detector of upright, frontal faces (King, 2009), for those who have dlib installed."""

import math
from dataclasses import dataclass, field
from threading import local
from typing import Any

import cv2
import numpy as np

from jaxfit.data.detectors.detector import Detection, Search, largest_first
from jaxfit.data.pictures import Pixels, to_grey
from jaxfit.errors import InputError

KIND = "dlib"

_SMALLEST = 80  # pixels of the smallest face that dlib finds: pictures are enlarged for smaller ones
_USUAL = 40  # of the smallest faces that are looked for by default: as dlib's users do, who enlarge once


@dataclass(frozen=True)
class DlibHog:
    """Finds faces that look more or less ahead, as dlib itself does in a picture that is enlarged twofold until the
    smallest faces are 80 pixels wide.

    Attributes:
        search: the smallest face, by default 40 pixels wide, in large pictures more; its score is not used.

    Raises:
        InputError: dlib is not installed.
    """

    search: Search = field(default_factory=Search)
    _of_thread: Any = field(default_factory=local, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        try:
            import dlib  # noqa: F401
        except ImportError:
            raise InputError('dlib is not installed: pip install "jaxfit[dlib]"') from None

    @property
    def kinds(self) -> tuple[str, ...]:
        """One."""
        return (KIND,)

    @property
    def colour(self) -> bool:
        """No: it looks at grey pictures."""
        return False

    @property
    def rough(self) -> bool:
        """Yes: a second pass saves failures, as ``scripts/detectors.py`` measures."""
        return True

    def __call__(self, image: Pixels) -> list[Detection]:
        """The faces in a picture, as in `jaxfit.data.pictures.to_eight_bits`, largest first."""
        if not hasattr(self._of_thread, "detector"):
            import dlib

            self._of_thread.detector = dlib.get_frontal_face_detector()
        grey = to_grey(image)
        height, width = grey.shape
        smallest = self.search.smallest_in(grey.shape, _USUAL)
        shrink = min(1.0, _SMALLEST / smallest)
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        if size != (width, height):
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        twofold = max(0, math.ceil(math.log2(_SMALLEST / smallest)))
        found, scores, _ = self._of_thread.detector.run(grey, twofold, 0.0)
        back = np.array([width / size[0], height / size[1]] * 2)
        # dlib's sides are pixels that belong to the box.
        boxes = [np.array([of.left(), of.top(), of.width(), of.height()], np.float64) for of in found]
        return largest_first(
            [Detection(box * back, KIND, score=score) for box, score in zip(boxes, scores, strict=True)]
        )
