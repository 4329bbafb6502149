"""Face detectors by the names that the command line and ``jaxfit.fit`` know."""

from collections.abc import Callable, Iterable

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
    "Detection",
    "Detector",
    "Search",
    "all_rough",
    "best_match",
    "detect_faces",
    "detector_named",
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


def detector_named(detector: str | Detector | None = DEFAULT_DETECTOR, search: Search = Search()) -> Detector:
    """The detector of a name: ``yunet``, ``yunet:FILE.onnx``, ``haar``, ``dlib`` or ``whole``.

    Args:
        detector: its name, None for the default one; a detector of your own is given back as it is.
        search: how faces are looked for.

    Raises:
        InputError: there is none of this name, its file is missing or damaged, what it needs is not installed; or a
            search for a detector that does not come by name.
    """
    if not isinstance(detector, str | None):
        if search != Search():
            raise InputError("expected a search for a detector that comes by name; a detector of your own has its own")
        return detector
    spec = detector or DEFAULT_DETECTOR
    name, _, path = spec.partition(":")
    if name in OF_FILES and path:
        found = OF_FILES[name](search, path)
    elif name in DETECTORS and not path:
        found = DETECTORS[name](search)
    else:
        known = [*DETECTORS, *(f"{of_file}:FILE" for of_file in OF_FILES)]
        raise InputError(f"expected a detector among {', '.join(known)}; got {spec!r}")
    # YuNet does it by itself, in less time.
    return AnyRotation(found) if search.any_rotation and not isinstance(found, YuNet) else found


def all_rough(kinds: Iterable[str]) -> bool:
    """Whether boxes of these kinds are all those of rough detectors (`Detector.rough`); without any they are not."""
    kinds = {*kinds}
    return bool(kinds) and kinds <= ROUGH_KINDS


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
        InputError: as `detector_named`.
        ImageError: the image is none of these.
    """
    return detector_named(detector, search)(to_eight_bits(image))
