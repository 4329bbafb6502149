"""``jaxfit fit``: find landmarks in pictures."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

import numpy as np

from jaxfit.cli.arguments import (
    add_boxes,
    add_initialisations,
    add_refine,
    given_boxes,
    out_folder,
    untrained_starts,
)
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.detectors import detect_faces
from jaxfit.data.images import find_images, read_image, write_image
from jaxfit.data.outputs import write_csv
from jaxfit.data.overlays import draw_head, draw_landmarks
from jaxfit.data.pts import write_pts
from jaxfit.evaluation.pose import ANGLES
from jaxfit.exceptions import ImageError
from jaxfit.fitting import Fits, fit, require_refinable
from jaxfit.models.files import load
from jaxfit.models.model import SQUARE, Model

# Pictures that are read, fitted and written together; it bounds memory.
_CHUNK = 16


@dataclass(frozen=True)
class _Face:
    """A face to fit: a row of ``landmarks.csv`` to be."""

    picture: Path
    name: str
    number: int
    kind: str
    box: np.ndarray
    rgb: np.ndarray

    @property
    def label(self) -> str:
        """Name of the face's own files."""
        return f"{self.name}_{self.number}"


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "fit",
        help="find landmarks in pictures",
        description="Find landmarks in pictures, with 3D models also the 3D shape and pose of the heads. Writes "
        "landmarks.csv, a .pts file a face and overlay pictures, and for 3D models heads.csv.",
    )
    command.add_argument("pictures", nargs="+", metavar="IMAGE_OR_DIR", help="pictures, or folders of pictures")
    command.add_argument("--model", default="sdm68", help="a bundled model's name or a model file (default: sdm68)")
    add_boxes(command, "faces are found by OpenCV's frontal and profile Haar cascades")
    add_initialisations(command, "starts a face; several, for models trained for it, find turned faces")
    add_refine(command)
    command.add_argument("--out", required=True, metavar="DIR", help="where the results go")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Fit and write; 1 if no face was fitted at all."""
    model = load(options.model)
    require_refinable(model, options.refine)
    boxes = given_boxes(options, model)
    pictures = find_images(options.pictures)
    folder = out_folder(options.out)
    for part in ("pts", "overlays"):
        out_folder(str(folder / part))
    names = _unique_names(pictures)
    rows: list[list[object]] = []
    heads: list[list[object]] = []
    problems: list[str] = []
    with Bars() as bars:
        for first in range(0, len(pictures), _CHUNK):
            bars("fitting pictures" if first else "compiling, then fitting pictures", first, len(pictures))
            faces = []
            for picture in pictures[first : first + _CHUNK]:
                try:
                    faces += _faces(picture, names[picture], boxes, options.box_kind)
                except ImageError as error:
                    problems.append(str(error))
            fits = _fit(model, faces, options)
            problems += [f"{faces[number].picture}: {why}" for number, why in fits.problems.items()]
            problems += _write(folder, model, faces, fits)
            fitted = [int(number) for number in np.flatnonzero(fits.fitted)]
            rows += [_row(faces[number], fits.landmarks[number]) for number in fitted]
            heads += [_head(faces[number], fits, number) for number in fitted]
        bars("fitting pictures", len(pictures), len(pictures))
    points = [f"{axis}{i}" for i in range(1, model.scheme.count + 1) for axis in "xy"]
    write_csv(folder / "landmarks.csv", ["image", "face", "box", "x", "y", "width", "height", *points], rows)
    if model.solid is not None:
        _write_heads(folder / "heads.csv", model, heads)
    if unknown := sorted({str(row[2]) for row in rows} - model.placements.keys()):
        problems.append(
            f"{options.model} does not know how faces lie in {', '.join(unknown)} boxes and took them for squares "
            "around the landmarks: do not trust these fits, give boxes with --boxes"
        )
    if boxes is not None and (unused := boxes.keys() - {picture.name for picture in pictures}):
        problems.append(f"{options.boxes}: rows for pictures that were not given: {len(unused)}, such as {min(unused)}")
    report_problems(untrained_starts(options.model, model, options.initialisations) + problems)
    print(f"pictures: {len(pictures)}, faces fitted: {len(rows)}, model: {options.model}")
    written = ["landmarks.csv", *(["heads.csv"] if model.solid is not None else []), "pts", "overlays"]
    print(f"written: {', '.join(str(folder / name) for name in written)}")
    return 0 if rows else 1


def _unique_names(pictures: Sequence[Path]) -> dict[Path, str]:
    """What the results of each picture are called: its stem, numbered where several pictures share it."""
    names: dict[Path, str] = {}
    taken: set[str] = set()
    for picture in pictures:
        candidates = chain([picture.stem], (f"{picture.stem}-{number}" for number in count(2)))
        names[picture] = next(name for name in candidates if name not in taken)
        taken.add(names[picture])
    return names


def _faces(picture: Path, name: str, boxes: Mapping[str, Sequence[np.ndarray]] | None, kind: str) -> list[_Face]:
    """The faces of a picture: those given, or those that the detectors find."""
    rgb = read_image(picture)
    if boxes is None:
        found = [(face.box, str(face.kind)) for face in detect_faces(rgb)]
        nothing = "no face found; give face boxes with --boxes"
    else:
        found = [(box, kind) for box in boxes.get(picture.name, [])]
        nothing = "no row with this file name in --boxes"
    if not found:
        raise ImageError(f"{picture}: {nothing}")
    return [_Face(picture, name, number, box_kind, box, rgb) for number, (box, box_kind) in enumerate(found, 1)]


def _fit(model: Model, faces: Sequence[_Face], options: argparse.Namespace) -> Fits:
    """The fits of faces found in pictures."""
    # A model that was trained where a detector found too few faces does not know how its boxes lie.
    kinds = [face.kind if face.kind in model.placements else SQUARE for face in faces]
    return fit(
        model,
        [face.rgb for face in faces],
        np.array([face.box for face in faces]).reshape(-1, 4),
        kind=kinds,
        initialisations=options.initialisations,
        rotations=tuple(options.rotations),
        refine=options.refine,
    )


def _write(folder: Path, model: Model, faces: Sequence[_Face], fits: Fits) -> list[str]:
    """A ``.pts`` file for each face, and one overlay for each picture; returns what could not be written."""
    problems = []
    overlays: dict[str, np.ndarray] = {}
    for number in map(int, np.flatnonzero(fits.fitted)):
        face = faces[number]
        write_pts(folder / "pts" / f"{face.label}.pts", fits.landmarks[number])
        overlays[face.name] = _drawn(overlays.get(face.name, face.rgb), model, face, fits, number)
    for name, overlay in overlays.items():
        try:
            write_image(folder / "overlays" / f"{name}.jpg", overlay)
        except ImageError as error:
            problems.append(str(error))
    return problems


def _drawn(canvas: np.ndarray, model: Model, face: _Face, fits: Fits, number: int) -> np.ndarray:
    """A picture with a fit drawn over it, in 3D if the model has that."""
    if fits.landmarks_3d is None or fits.pose is None:
        return draw_landmarks(canvas, fits.landmarks[number], model.scheme, box=face.box)
    # Of alignments, what is written in 2D: the landmarks that were found, at the aligned shape's depths.
    solid = np.column_stack([fits.landmarks[number], fits.landmarks_3d[number, :, 2]])
    return draw_head(canvas, solid, fits.pose[number], model.scheme, box=face.box)


def _write_heads(path: Path, model: Model, rows: Sequence[Sequence[object]]) -> None:
    points = [f"{axis}{i}" for i in range(1, model.scheme.count + 1) for axis in "xyz"]
    modes = 0 if model.solid is None else len(model.solid.model.deviations)
    write_csv(path, ["image", "face", *ANGLES, "scale", *points, *(f"b{i + 1}" for i in range(modes))], rows)


def _head(face: _Face, fits: Fits, number: int) -> list[object]:
    parts = (fits.pose, fits.scale, fits.landmarks_3d, fits.b)
    numbers = [value for part in parts if part is not None for value in np.ravel(part[number])]
    return [str(face.picture), face.label, *(f"{value:.3f}" for value in numbers)]


def _row(face: _Face, landmarks: np.ndarray) -> list[object]:
    numbers = [f"{value:.3f}" for value in (*face.box, *landmarks.reshape(-1))]
    return [str(face.picture), face.label, face.kind, *numbers]
