"""Face detectors by the names that the command line and ``jaxfit.fit`` know."""

from collections.abc import Callable

import numpy as np

from jaxfit.data.detectors.detector import Detection, Detector, best_match
from jaxfit.data.detectors.dlib_hog import DlibHog
from jaxfit.data.detectors.haar import Haar
from jaxfit.data.detectors.whole import Whole
from jaxfit.data.detectors.yunet import YuNet
from jaxfit.errors import InputError

__all__ = ["DEFAULT_DETECTOR", "DETECTORS", "Detection", "Detector", "best_match", "detect_faces", "detector_named"]

DEFAULT_DETECTOR = "haar"

# Made without arguments, or of a file.
DETECTORS: dict[str, Callable[[], Detector]] = {DEFAULT_DETECTOR: Haar, "dlib": DlibHog, "whole": Whole}
OF_FILES: dict[str, Callable[[str], Detector]] = {"yunet": YuNet}


def detector_named(spec: str) -> Detector:
    """The detector that ``spec`` names: ``haar``, ``dlib``, ``whole``, or ``yunet:FILE.onnx``.

    Raises:
        InputError: there is none of this name, its file is missing or damaged, or what it needs is not installed.
    """
    name, _, path = spec.partition(":")
    if name in DETECTORS and not path:
        return DETECTORS[name]()
    if name in OF_FILES and path:
        return OF_FILES[name](path)
    known = [*DETECTORS, *(f"{of_file}:FILE" for of_file in OF_FILES)]
    raise InputError(f"expected a detector among {', '.join(known)}; got {spec!r}")


def detect_faces(image: np.ndarray, detector: str | Detector = DEFAULT_DETECTOR) -> list[Detection]:
    """The faces in a picture, largest first; empty if none is found.

    Args:
        image: uint8 (H, W) grey or (H, W, 3) RGB.
        detector: ``"haar"``, OpenCV's cascades, needs nothing else; ``"yunet:FILE.onnx"`` finds more, small and turned
            faces above all; ``"dlib"`` is dlib's; ``"whole"`` takes the whole picture for a face. Or one of your own,
            as ``Detector`` says.

    Raises:
        InputError: as `detector_named`.
    """
    return (detector_named(detector) if isinstance(detector, str) else detector)(image)
