"""Face detectors by the names that the command line and ``jaxfit.fit`` know."""

from collections.abc import Iterable
from dataclasses import fields

from jaxfit.data.detectors.detector import AnyRotation, Detection, Detector, DetectorEntry, Search, best_match
from jaxfit.data.detectors.dlib_hog import KIND as DLIB
from jaxfit.data.detectors.dlib_hog import DlibHog
from jaxfit.data.detectors.haar import FRONTAL, PROFILE, Haar
from jaxfit.data.detectors.whole import KIND as WHOLE
from jaxfit.data.detectors.whole import Whole
from jaxfit.data.detectors.yunet import KIND as YUNET
from jaxfit.data.detectors.yunet import YuNet
from jaxfit.data.pictures import Pixels, to_eight_bits
from jaxfit.errors import InputError

__all__ = [
    "DEFAULT_DETECTOR",
    "DETECTORS",
    "Detection",
    "Detector",
    "DetectorEntry",
    "Search",
    "all_rough",
    "best_match",
    "box_kinds",
    "detect_faces",
    "detector_named",
    "detector_specs",
]

DEFAULT_DETECTOR = "yunet"

DETECTORS: dict[str, DetectorEntry] = {
    DEFAULT_DETECTOR: DetectorEntry(YuNet, (YUNET,), rotates=True, make_of_file=YuNet),
    "haar": DetectorEntry(Haar, (FRONTAL, PROFILE), rough=True, unused=("score",)),
    "dlib": DetectorEntry(DlibHog, (DLIB,), rough=True, unused=("score",), package="dlib"),
    "whole": DetectorEntry(lambda search: Whole(), (WHOLE,), rough=True, unused=("smallest", "score", "any_rotation")),
}


def detector_specs() -> list[str]:
    """What `detector_named` takes: names, and ``NAME:FILE`` for detectors that are read from a file as well."""
    return [*DETECTORS, *(f"{name}:FILE" for name, entry in DETECTORS.items() if entry.make_of_file is not None)]


def detector_named(detector: str | Detector | None = DEFAULT_DETECTOR, search: Search = Search()) -> Detector:
    """The detector of a name: ``yunet``, ``yunet:FILE.onnx``, ``haar``, ``dlib`` or ``whole``.

    Args:
        detector: its name, None for the default one; a detector of your own is given back as it is.
        search: how faces are looked for.

    Raises:
        InputError: the name is unknown; the detector's file is missing or damaged; a package that it needs is not
            installed; or `search` is given for a detector of your own, or has an option that the detector does not use.
    """
    if not isinstance(detector, str | None):
        if not isinstance(detector, Detector):
            raise InputError(
                f"expected a detector's name ({', '.join(detector_specs())}) or a detector; got {detector!r:.60}"
            )
        if search != Search():
            raise InputError("expected a search for a detector that comes by name; a detector of your own has its own")
        return detector
    spec = DEFAULT_DETECTOR if detector is None else detector
    name, _, path = spec.partition(":")
    entry = DETECTORS.get(name)
    if entry is None or (path and entry.make_of_file is None):
        raise InputError(f"expected a detector among {', '.join(detector_specs())}; got {spec!r}")
    given = [field.name for field in fields(Search) if getattr(search, field.name) != field.default]
    if unused := [each.replace("_", " ") for each in given if each in entry.unused]:
        raise InputError(
            f"the detector {name} does not use {', '.join(unused)}: leave it out, or take another detector"
        )
    found = entry.make_of_file(search, path) if path and entry.make_of_file is not None else entry.make(search)
    return AnyRotation(found) if search.any_rotation and not entry.rotates else found


def box_kinds() -> list[str]:
    """The kinds of boxes that the detectors of the registry draw."""
    return [kind for entry in DETECTORS.values() for kind in entry.kinds]


def all_rough(kinds: Iterable[str]) -> bool:
    """Whether boxes of these kinds are all those of rough detectors (`Detector.rough`); without any they are not."""
    kinds = {*kinds}
    return bool(kinds) and kinds <= {kind for entry in DETECTORS.values() if entry.rough for kind in entry.kinds}


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
        ImageError: the image cannot be used.
    """
    return detector_named(detector, search)(to_eight_bits(image))
