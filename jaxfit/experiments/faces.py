"""The faces of a report: thumbnails, the gallery, and the best, middling and worst fits."""

from pathlib import Path

import cv2
import numpy as np

from jaxfit.data.boxes import bounding_square
from jaxfit.data.images import read_image
from jaxfit.exceptions import ImageError
from jaxfit.experiments.config import Config
from jaxfit.experiments.document import Gallery, GalleryFace
from jaxfit.experiments.results import DatasetResults

_SIDE = 144  # pixels of a thumbnail
_MARGIN = 0.35  # around the labels, in sides of their square
_QUALITY = 75


class Thumbnails:
    """Square pictures of a dataset's faces, and points in their pixels.

    Args:
        dataset: whose faces.
        pictures: whether to read them; without, there are only the points.
    """

    def __init__(self, dataset: DatasetResults, pictures: bool):
        self._dataset = dataset
        self._pictures = pictures

    def picture(self, number: int) -> np.ndarray | None:
        """RGB, uint8; None if there is none to be shown."""
        if not self._pictures:
            return None
        try:
            rgb = read_image(Path(str(self._dataset.faces["image"][number])), exif=False)
        except ImageError:
            return None
        x, y, side = self._square(number)
        scale = _SIDE / side
        matrix = np.array([[scale, 0, -scale * x], [0, scale, -scale * y]])
        return cv2.warpAffine(rgb, matrix, (_SIDE, _SIDE), flags=cv2.INTER_AREA)

    def points(self, number: int, points: np.ndarray) -> np.ndarray:
        """Points (L, 2) of the picture in pixels of the thumbnail."""
        x, y, side = self._square(number)
        return (points - [x, y]) * (_SIDE / side)

    def _square(self, number: int) -> tuple[float, float, float]:
        x, y, side, _ = bounding_square(self._dataset.faces["landmarks"][number])
        return x - _MARGIN * side, y - _MARGIN * side, (1 + 2 * _MARGIN) * side


def gallery(datasets: tuple[DatasetResults, ...], config: Config, most: int, pictures: bool) -> Gallery:
    """Up to ``most`` faces of each dataset, spread evenly from the best fitted to the worst."""
    faces = []
    for dataset in datasets:
        errors = {plan.name: dataset.errors(plan.name, config) for plan in config.methods}
        thumbnails = Thumbnails(dataset, pictures)
        for number in spread_by_rank(next(iter(errors.values())), most):
            picture = thumbnails.picture(number)
            faces.append(
                GalleryFace(
                    dataset=dataset.name,
                    face=str(dataset.faces["face"][number]),
                    size=_SIDE,
                    jpeg=None if picture is None else _jpeg(picture),
                    truth=thumbnails.points(number, dataset.faces["landmarks"][number]),
                    fits={name: thumbnails.points(number, fits[number]) for name, fits in dataset.fits.items()},
                    errors={name: float(values[number]) for name, values in errors.items()},
                    yaw=float(dataset.faces["pose"][number, 2]),
                    pitch=float(dataset.faces["pose"][number, 1]),
                )
            )
    note = (
        "Labels in red, fits in cyan. Errors of 3D methods are in 3D. Yaw and pitch are the labels', or those of a 3D "
        "shape that is aligned to them."
    )
    return Gallery("Faces", tuple(faces), {dataset.name: dataset.scheme.lines for dataset in datasets}, note)


def spread_by_rank(errors: np.ndarray, most: int) -> list[int]:
    """Numbers of up to ``most`` faces that were measured, spread evenly from the best to the worst."""
    order = np.argsort(errors, kind="stable")
    ranked = order[~np.isnan(errors[order])].tolist()
    places = np.linspace(0, len(ranked) - 1, most if ranked else 0).round().astype(int)
    return [ranked[place] for place in np.unique(places)]


def _jpeg(rgb: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
