"""What the page asks for: pictures in, faces out, as plain data for JSON. Nothing here knows of HTTP."""

from collections.abc import Mapping
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Any

import numpy as np

from jaxfit.data.detectors import Detector
from jaxfit.data.headers import JPEG, PNG, is_heic, looks_like_picture, stored_size
from jaxfit.data.overlays import outline_of, solid_points
from jaxfit.data.pictures import decode_image, require_heif
from jaxfit.data.rows import Row, rounded
from jaxfit.errors import ImageError, InputError, JaxfitError
from jaxfit.fitting.fit import fit, warm_up
from jaxfit.fitting.pipeline import Fitting
from jaxfit.models.model import Model

MOST_PIXELS = 50_000_000  # of a picture; decoded, it takes three bytes each


class Closed(JaxfitError):
    """Nothing is fitted any more."""


class Service:
    """Fits pictures with models and detectors by their names, one picture after the other.

    Args:
        models: by name; the first is the one to begin with.
        detectors: by name, likewise.

    Raises:
        InputError: there is no model, or no detector.
    """

    def __init__(self, models: Mapping[str, Model], detectors: Mapping[str, Detector]):
        if not models or not detectors:
            raise InputError(f"expected models and detectors; got {len(models)} and {len(detectors)}")
        self._models, self._detectors = models, detectors
        # Pictures take their turns; and detectors keep what they have read from files for the thread that they run in.
        self._worker = ThreadPoolExecutor(1, "fitting")

    def options(self) -> dict[str, Any]:
        """The models, with their landmarks and the lines that draw them, and the names of the detectors."""
        models = [
            {
                "name": name,
                "landmarks": model.scheme.count,
                "lines": model.scheme.lines,
                "solid": model.space_3d is not None,
            }
            for name, model in self._models.items()
        ]
        return {"models": models, "detectors": list(self._detectors)}

    def warm_up(self) -> None:
        """Compile, in the background, what the page begins with: the first model, for boxes of the first detector."""
        model, detector = next(iter(self._models.values())), next(iter(self._detectors.values()))
        self._worker.submit(warm_up, model, batches=(1,), passes=Fitting().passes_from(detector.rough))

    def fit(self, data: bytes, model: str, detector: str) -> dict[str, Any]:
        """The faces in a picture.

        Args:
            data: the bytes of a JPEG, PNG, WebP or BMP file; or of a HEIC file, with ``jaxfit[heif]``.
            model: the name of one of the models.
            detector: the name of one of the detectors.

        Returns:
            The picture's width and height, upright as its EXIF data say; its faces, as rows of ``faces.jsonl`` with the
            outlines of heads, but without names; and why others that were found have no fit. All coordinates are in
            pixels.

        Raises:
            InputError: no such model or detector, or the model does not know the detector's boxes.
            ImageError: not a picture, a damaged one, or one of too many pixels.
            Closed: the service was closed before it came to this picture.
        """
        chosen, finder = _named("model", self._models, model), _named("detector", self._detectors, detector)
        if is_heic(data):
            require_heif()
        size = stored_size(data)
        if size is None:
            if looks_like_picture(data) and not is_heic(data) and not data.startswith((JPEG, PNG, b"RIFF", b"BM")):
                raise ImageError(
                    "the picture: of a format that the page does not take, such as GIF, TIFF or AVIF, which `jaxfit "
                    "fit` reads; convert it to JPEG, PNG, WebP, BMP or HEIC"
                )
            raise ImageError("the picture: not a JPEG, PNG, WebP, BMP or HEIC file, or damaged")
        if size[0] * size[1] > MOST_PIXELS:
            most = MOST_PIXELS // 1_000_000
            raise ImageError(f"the picture: {size[0]} x {size[1]} pixels; expected at most {most} million")
        try:
            fitted = self._worker.submit(_fitted, data, chosen, finder)
        except RuntimeError:
            raise Closed("jaxfit is ending") from None
        try:
            return fitted.result()
        except CancelledError:
            raise Closed("jaxfit is ending") from None

    def close(self) -> None:
        """Finish what is being computed, and begin nothing more."""
        self._worker.shutdown(cancel_futures=True)


def _named(what: str, known: Mapping[str, Any], name: str) -> Any:
    if name not in known:
        raise InputError(f"expected a {what} among {', '.join(known)}; got {name!r}")
    return known[name]


def _fitted(data: bytes, model: Model, detector: Detector) -> dict[str, Any]:
    """What `Service.fit` gives."""
    image = decode_image(data)
    fits = fit(model, [image], detector=detector)
    return {
        "width": image.shape[1],
        "height": image.shape[0],
        "faces": [_face(row) for row in fits.rows()],
        "problems": [problem.why for problem in fits.problems if problem.row is not None],
    }


def _face(row: Row) -> dict[str, Any]:
    """One face: its row, but for the names that are made of a file's, and the outline of its head."""
    face = {name: value for name, value in row.items() if name not in ("image", "face")}
    solid = solid_points(row)
    if solid is None:
        return face
    outline = outline_of(solid, np.array(list(row["pose"].values())))
    return face | {"outline": {"corners": rounded(outline.corners), "axes": rounded(outline.axes)}}
