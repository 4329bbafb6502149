"""Face detectors by the names that the command line and ``jaxfit.fit`` know."""

from collections.abc import Callable

from jaxfit.data.detectors.detector import AnyRotation, Detection, Detector, Search, best_match
from jaxfit.data.detectors.dlib_hog import KIND as DLIB
from jaxfit.data.detectors.dlib_hog import DlibHog
from jaxfit.data.detectors.haar import FRONTAL, PROFILE, Haar
from jaxfit.data.detectors.whole import KIND as WHOLE
from jaxfit.data.detectors.whole import Whole
from jaxfit.data.detectors.yunet import YuNet
from jaxfit.data.pictures import Pixels, to_eight_bits
from jaxfit.errors import InputError

__all__ = [
    "DEFAULT_DETECTOR",
    "DETECTORS",
    "ROUGH_KINDS",
    "Detection",
    "Detector",
    "Search",
    "best_match",
    "detect_faces",
    "detector_named",
    "finder_of",
]

DEFAULT_DETECTOR = "yunet"

# Made of how faces are looked for, and some of a file as well.
DETECTORS: dict[str, Callable[[Search], Detector]] = {
    DEFAULT_DETECTOR: YuNet,
    "haar": Haar,
    "dlib": DlibHog,
    "whole": lambda search: Whole(),
}
# The boxes of rough detectors (`Detector.rough`).
ROUGH_KINDS = frozenset((FRONTAL, PROFILE, DLIB, WHOLE))
OF_FILES: dict[str, Callable[[Search, str], Detector]] = {"yunet": YuNet}


def detector_named(spec: str = DEFAULT_DETECTOR, search: Search = Search()) -> Detector:
    """The detector that ``spec`` names: ``yunet``, ``yunet:FILE.onnx``, ``haar``, ``dlib`` or ``whole``.

    Args:
        spec: its name.
        search: how faces are looked for.

    Raises:
        InputError: there is none of this name, its file is missing or damaged, or what it needs is not installed.
    """
    name, _, path = spec.partition(":")
    if name in OF_FILES and path:
        detector = OF_FILES[name](search, path)
    elif name in DETECTORS and not path:
        detector = DETECTORS[name](search)
    else:
        known = [*DETECTORS, *(f"{of_file}:FILE" for of_file in OF_FILES)]
        raise InputError(f"expected a detector among {', '.join(known)}; got {spec!r}")
    # YuNet does it by itself, in less time.
    return AnyRotation(detector) if search.any_rotation and not isinstance(detector, YuNet) else detector


def finder_of(detector: str | Detector | None, search: Search = Search()) -> Detector:
    """A detector of one's own, or the one of this name; None is the default one.

    Raises:
        InputError: as `detector_named`; or a search for a detector that does not come by name.
    """
    if isinstance(detector, str | None):
        return detector_named(detector or DEFAULT_DETECTOR, search)
    if search != Search():
        raise InputError("expected a search for a detector that comes by name; a detector of your own has its own")
    return detector


def detect_faces(
    image: Pixels, detector: str | Detector = DEFAULT_DETECTOR, search: Search = Search()
) -> list[Detection]:
    """The faces in a picture, largest first; empty if none is found.

    Args:
        image: an array or a PIL image, as in ``jaxfit.fit``.
        detector: ``"yunet"``, a small network that finds faces of any pose and comes with the package; ``"haar"``,
            OpenCV's cascades; ``"dlib"``, dlib's; ``"whole"`` takes the whole picture for a face. Or one of your own,
            as ``Detector`` asks for.
        search: how faces are looked for, by detectors that come by name.

    Raises:
        InputError: as `finder_of`.
        ImageError: the image is none of these.
    """
    return finder_of(detector, search)(to_eight_bits(image))
