"""Faces in a report: the gallery, and a figure from the best fit to the worst."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.crops import cut_face, to_crop
from jaxfit.data.pictures import read_image
from jaxfit.errors import ImageError
from jaxfit.experiments.config import Config, MethodPlan
from jaxfit.experiments.figures import plot_fits
from jaxfit.experiments.report_parts import Gallery, GalleryFace, ReportFigure
from jaxfit.experiments.results import DatasetResults
from jaxfit.image.frame import Frame

SIDE = 144  # pixels of a thumbnail
_FRAME = Frame(SIDE, SIDE / 1.7)  # a margin of 0.35 around the labels, in sides of their square
_QUALITY = 75
_IN_2D = "For 3D alignment the 2D fit is drawn to which the head is aligned; its errors, in 3D, are those of the head."


class Thumbnails:
    """Square pictures of a dataset's faces, and points in their pixels.

    Args:
        images: N paths, of the faces' pictures.
        landmarks: N arrays (L, 2) of their labels.
        pictures: whether to read them; without, there are only the points.
    """

    def __init__(
        self, images: Sequence[str | Path] | np.ndarray, landmarks: Sequence[np.ndarray] | np.ndarray, pictures: bool
    ):
        self._images = images
        self._landmarks = landmarks
        self._pictures = pictures

    def picture(self, number: int) -> np.ndarray | None:
        """RGB, uint8; None if there is none to be shown."""
        if not self._pictures:
            return None
        try:
            rgb = read_image(Path(str(self._images[number])))
        except ImageError:
            return None
        # Colours come along as a third axis.
        return cut_face(rgb, *self._square(number), _FRAME, colour=True).pixels

    def points(self, number: int, points: np.ndarray) -> np.ndarray:
        """Points (L, 2) of the picture in pixels of the thumbnail."""
        centre, side = self._square(number)
        scale = side / _FRAME.face
        return to_crop(points, scale, centre - scale * _FRAME.middle)

    def _square(self, number: int) -> tuple[np.ndarray, float]:
        square = bounding_square(self._landmarks[number])
        return box_centre(square), float(square[2])


def fits_figure(
    dataset: DatasetResults, config: Config, plans: list[MethodPlan], most: int, pictures: bool
) -> ReportFigure:
    """Up to ``most`` faces, from the best fit of the first method to its worst."""
    in_3d = plans[0].in_3d
    errors = dataset.errors(plans[0].name, config)
    numbers = spread_by_rank(errors, most)
    thumbnails = Thumbnails(dataset.faces["image"], dataset.faces["landmarks"], pictures)
    titles = [f"{errors[number]:.3f}" for number in numbers]
    titles[0], titles[-1] = f"best: {titles[0]}", f"worst: {titles[-1]}"
    truths = [thumbnails.points(number, dataset.faces["landmarks"][number]) for number in numbers]
    aligned = [plan.name for plan in plans if plan.method == "alignment3d"]
    fits = {
        f"{plan.name} (2D)" if plan.name in aligned else plan.name: [
            thumbnails.points(number, dataset.fits[plan.name][number]) for number in numbers
        ]
        for plan in plans
    }
    pictures_of = [thumbnails.picture(number) for number in numbers]
    figure = plot_fits(pictures_of, truths, fits, titles, dataset.scheme, SIDE)
    return ReportFigure(
        f"fits-{dataset.name}-{'3d' if in_3d else '2d'}",
        f"{dataset.name}: from the best to the worst fit of {plans[0].name}",
        figure,
        _IN_2D if aligned else "",
    )


def gallery(datasets: tuple[DatasetResults, ...], config: Config, most: int, pictures: bool) -> Gallery:
    """Up to ``most`` faces of each dataset, spread evenly from the best fitted to the worst."""
    faces, unread = [], 0
    for dataset in datasets:
        errors = {plan.name: dataset.errors(plan.name, config) for plan in config.methods}
        thumbnails = Thumbnails(dataset.faces["image"], dataset.faces["landmarks"], pictures)
        for number in spread_by_rank(next(iter(errors.values())), most):
            picture = thumbnails.picture(number)
            unread += pictures and picture is None
            faces.append(
                GalleryFace(
                    dataset=dataset.name,
                    face=str(dataset.faces["face"][number]),
                    size=SIDE,
                    jpeg=None if picture is None else jpeg_of(picture),
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
    if any(plan.method == "alignment3d" for plan in config.methods):
        note += f" {_IN_2D}"
    if unread:
        note += f" {unread} pictures are no longer where they were, or cannot be read: run the experiment again."
    return Gallery("Faces", tuple(faces), {dataset.name: dataset.scheme.lines for dataset in datasets}, note)


def spread_by_rank(errors: np.ndarray, most: int) -> list[int]:
    """Numbers of up to ``most`` faces that were measured, spread evenly from the best to the worst."""
    order = np.argsort(errors, kind="stable")
    ranked = order[~np.isnan(errors[order])].tolist()
    places = np.linspace(0, len(ranked) - 1, most if ranked else 0).round().astype(int)
    return [ranked[place] for place in np.unique(places)]


def jpeg_of(rgb: np.ndarray) -> bytes:
    """A picture, uint8 (H, W, 3), as a JPEG."""
    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
