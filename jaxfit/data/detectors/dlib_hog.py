"""dlib's detector of upright, frontal faces (King, 2009), for those who have dlib installed."""

from threading import local

import cv2
import numpy as np

from jaxfit.data.detectors.detector import Detection, largest_first
from jaxfit.data.pictures import to_grey
from jaxfit.errors import InputError

KIND = "dlib"

_LONG_SIDE = 400
_SMALLEST = 80  # pixels of the smallest face that dlib finds: pictures are enlarged for smaller ones
_SMALLEST_SHARE = 1 / 6  # of the picture's shorter side


class DlibHog:
    """Finds faces that look more or less ahead.

    Raises:
        InputError: dlib is not installed.
    """

    def __init__(self) -> None:
        try:
            import dlib
        except ImportError:
            raise InputError('dlib is not installed: pip install "jaxfit[dlib]"') from None
        self._make = dlib.get_frontal_face_detector
        self._of_thread = local()

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
        """Yes: docs/boxes.md has both."""
        return True

    def __call__(self, image: np.ndarray) -> list[Detection]:
        """The faces in a picture, uint8 (H, W) grey or (H, W, 3) RGB, largest first."""
        if not hasattr(self._of_thread, "detector"):
            self._of_thread.detector = self._make()
        grey = to_grey(image)
        height, width = grey.shape
        factor = min(_LONG_SIDE / max(height, width), max(1.0, _SMALLEST / (_SMALLEST_SHARE * min(height, width))))
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        back = np.array([width / size[0], height / size[1]] * 2)
        found = self._of_thread.detector(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))
        # dlib's sides are pixels that belong to the box.
        boxes = [np.array([of.left(), of.top(), of.width(), of.height()], np.float64) for of in found]
        return largest_first([Detection(box * back, KIND) for box in boxes])
