"""YuNet (Wu, Peng and Yu, 2023), a small network that OpenCV runs, from the ONNX file that the user has of it."""

from pathlib import Path
from threading import local

import cv2
import numpy as np

from jaxfit.data.detectors.detector import Detection, largest_first
from jaxfit.errors import InputError

KIND = "yunet"

# Larger pictures are shrunk: what is then too small to be found is too small to be fitted.
_LONG_SIDE = 640
_SURE = 0.7  # score from which a find is a face
_SAME = 0.3  # overlap from which two finds are one face


class YuNet:
    """Finds faces of any pose, also small ones and several in a picture.

    Args:
        path: the ONNX file, such as OpenCV's model zoo has it.

    Raises:
        InputError: the file is missing, or not a YuNet that this OpenCV can run.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(f"yunet: expected YuNet's ONNX file; there is no file {path}")
        self._of_thread = local()  # a network looks at one picture at a time: each thread has its own
        try:
            self._found(np.zeros((64, 64, 3), np.uint8))
        except cv2.error as error:
            raise InputError(
                f"yunet: {path} is not a YuNet that OpenCV {cv2.__version__} can run; {error.err}"
            ) from None

    @property
    def kinds(self) -> tuple[str, ...]:
        """One kind for all poses."""
        return (KIND,)

    @property
    def colour(self) -> bool:
        """Yes."""
        return True

    @property
    def rough(self) -> bool:
        """No: docs/boxes.md has both."""
        return False

    def __call__(self, image: np.ndarray) -> list[Detection]:
        """The faces in a picture, uint8 (H, W) grey or (H, W, 3) RGB, largest first."""
        bgr = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if image.ndim == 2 else cv2.COLOR_RGB2BGR)
        shrink = min(1.0, _LONG_SIDE / max(bgr.shape[:2]))
        if shrink < 1:
            bgr = cv2.resize(bgr, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        boxes = self._found(bgr)[:, :4].astype(np.float64)
        whole = np.isfinite(boxes).all(1) & (boxes[:, 2:] > 0).all(1)
        return largest_first([Detection(box / shrink, KIND) for box in boxes[whole]])

    def _found(self, bgr: np.ndarray) -> np.ndarray:
        """A row a face: x, y, width and height come first."""
        size = (bgr.shape[1], bgr.shape[0])
        if not hasattr(self._of_thread, "network"):
            self._of_thread.network = cv2.FaceDetectorYN.create(str(self.path), "", size, _SURE, _SAME)
        self._of_thread.network.setInputSize(size)
        faces = self._of_thread.network.detect(bgr)[1]
        return np.empty((0, 15), np.float32) if faces is None else faces
