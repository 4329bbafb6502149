"""``jaxfit fit``: find landmarks in pictures, however many, and go on after having been stopped."""

import argparse
import hashlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

import jaxfit
from jaxfit.cascade.fit import check_rotations
from jaxfit.cli.arguments import (
    add_boxes,
    add_detector,
    add_initialisations,
    add_pictures,
    add_refine,
    given_boxes,
    out_folder,
    untrained_starts,
)
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.data.contact_sheet import write_contact_sheet
from jaxfit.data.detectors import DEFAULT_DETECTOR, Detector, detector_named
from jaxfit.data.fitted import Chunks, FittedFace, Problem
from jaxfit.data.images import find_images, read_image, read_upright, write_image
from jaxfit.data.outputs import require_same_settings, write_csv
from jaxfit.data.overlays import draw_head, draw_landmarks
from jaxfit.data.writers import DEFAULT_FORMATS, WRITERS, Results, require_pyarrow
from jaxfit.detecting import find_faces
from jaxfit.exceptions import ImageError, InputError
from jaxfit.fitting import Fits, fit, passes_from, require_refinable
from jaxfit.models.files import load
from jaxfit.models.model import Model

# Pictures that are fitted together and kept when done: what a killed run loses at most.
_CHUNK = 256
_UNFINISHED = ".unfinished"
_DIGITS = 3  # after the point


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "fit",
        help="find landmarks in pictures",
        description="Find landmarks in pictures, with 3D models also the 3D shape and pose of the heads. Writes tables "
        "and other formats, overlay pictures, and problems.csv. A run that was stopped goes on when started again.",
    )
    add_pictures(command)
    add_boxes(command, "a detector finds the faces")
    add_detector(command, "finds the faces; haar, OpenCV's cascades, unless given")
    add_initialisations(command, "starts a face; several, for models trained for it, find turned faces")
    add_refine(command)
    command.add_argument("--out", required=True, metavar="DIR", help="where the results go")
    command.add_argument(
        "--format",
        nargs="+",
        choices=WRITERS,
        default=list(DEFAULT_FORMATS),
        help=f"what to write (default: {' '.join(DEFAULT_FORMATS)})",
    )
    command.add_argument(
        "--no-overlays", action="store_true", help="do not write pictures with the faces drawn over them"
    )
    command.add_argument(
        "--contact-sheet", action="store_true", help="write one picture of many faces, the doubtful first"
    )
    command.add_argument("--overwrite", action="store_true", help="begin anew where an unfinished run is in the way")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Fit and write; 1 if no face was fitted at all."""
    check_rotations(options.initialisations, tuple(options.rotations))
    model = load(options.model)
    require_refinable(model, options.refine)
    boxes = given_boxes(options, model)
    if "parquet" in options.format:
        require_pyarrow()
    pictures = find_images(options.pictures, options.recursive)
    detector = _detector(options, model)
    folder = out_folder(options.out)
    # Overlays of a run before this one are no pictures to fit.
    pictures = [picture for picture in pictures if folder.absolute() not in picture.absolute().parents]
    unfinished = folder / _UNFINISHED
    if options.overwrite:
        shutil.rmtree(unfinished, ignore_errors=True)
    chunks = Chunks(out_folder(str(unfinished)))
    try:
        require_same_settings(unfinished / "settings.json", _settings(options, pictures))
    except InputError as error:
        raise InputError(f"{error}, or --overwrite to begin anew") from None
    with Bars() as bars:
        _fit_all(_Work(model, options, boxes, detector, folder), pictures, chunks, bars)
        modes = None if model.solid is None else len(model.solid.model.deviations)
        results = Results(chunks.faces, model.scheme, modes, model.confidence is not None)
        bars("writing results", 0, 1)
        written = list(chain.from_iterable(WRITERS[name](folder, results) for name in dict.fromkeys(options.format)))
        problems = list(chunks.problems())
        write_csv(folder / "problems.csv", ["image", "problem"], ([each.image, each.why] for each in problems))
        if options.contact_sheet:
            problems += write_contact_sheet(folder / "contact-sheet.jpg", chunks.faces, model.scheme)
            written.append("contact-sheet.jpg")
    faces = sum(1 for _ in chunks.faces())
    shutil.rmtree(unfinished)
    written += ["problems.csv", *([] if options.no_overlays else ["overlays"])]
    told = [f"{each.image}: {each.why}" for each in problems]
    if boxes is not None and (unused := boxes.keys() - {picture.name for picture in pictures}):
        told.append(f"{options.boxes}: rows for pictures that were not given: {len(unused)}, such as {min(unused)}")
    report_problems(untrained_starts(options.model, model, options.initialisations) + told)
    print(f"pictures: {len(pictures)}, faces fitted: {faces}, model: {options.model}")
    print(f"written: {', '.join(str(folder / name) for name in written)}")
    return 0 if faces else 1


def _settings(options: argparse.Namespace, pictures: Sequence[Path]) -> dict[str, object]:
    """What has to be the same for an unfinished run to go on."""
    told = ("model", "box_kind", "detector", "initialisations", "rotations", "refine", "no_overlays")
    files = {
        f"{name} file": _digest(path.read_bytes())
        for name in ("model", "boxes")
        if (path := Path(getattr(options, name) or "")).is_file()
    }
    names = "\0".join(map(str, pictures)).encode("utf-8", "surrogateescape")
    pictures_told = {"pictures": len(pictures), "pictures' names": _digest(names)}
    return {"jaxfit": jaxfit.__version__, **{name: getattr(options, name) for name in told}, **files, **pictures_told}


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def _detector(options: argparse.Namespace, model: Model) -> Detector:
    """What finds the faces if there are no boxes.

    Raises:
        InputError: there is none of this name, the model does not know its boxes, or there are boxes.
    """
    if options.boxes is not None and options.detector is not None:
        raise InputError("expected --boxes or a --detector that finds them; got both")
    detector = detector_named(options.detector or DEFAULT_DETECTOR)
    for kind in detector.kinds if options.boxes is None else ():
        model.placement(kind)
    return detector


@dataclass(frozen=True)
class _Work:
    """What is done with each chunk of pictures."""

    model: Model
    options: argparse.Namespace
    boxes: Mapping[str, Sequence[np.ndarray]] | None
    detector: Detector
    folder: Path


@dataclass(frozen=True)
class _Boxes:
    """Boxes of faces in the pictures of a chunk: the number of each one's picture, and what drew it."""

    pictures: Sequence[int]
    boxes: np.ndarray
    kinds: Sequence[str]


def _fit_all(work: _Work, pictures: Sequence[Path], chunks: Chunks, bars: Bars) -> None:
    """Fit the pictures, chunk by chunk, but for those that were fitted before."""
    overlays = None if work.options.no_overlays else out_folder(str(work.folder / "overlays"))
    names = _unique_names(pictures)
    firsts = range(0, len(pictures), _CHUNK)
    if before := sum(chunks.has(number) for number in range(len(firsts))):
        print(f"going on: {min(before * _CHUNK, len(pictures))} of {len(pictures)} pictures were fitted before")
    for number, first in enumerate(firsts):
        some = pictures[first : first + _CHUNK]
        labels = [next(names) for _ in some]
        if chunks.has(number):
            continue
        bars("fitting pictures" if first else "compiling, then fitting pictures", first, len(pictures))
        faces, problems = _fit_some(work, some, labels)
        if overlays is not None:
            problems += _draw(overlays, work.model, some, labels, faces)
        chunks.put(number, faces, problems)
    bars("fitting pictures", len(pictures), len(pictures))


def _unique_names(pictures: Sequence[Path]) -> Iterator[str]:
    """What the results of each picture are called: its stem, numbered where several pictures share it."""
    taken: set[str] = set()
    for picture in pictures:
        candidates = chain([picture.stem], (f"{picture.stem}-{number}" for number in count(2)))
        name = next(name for name in candidates if name not in taken)
        taken.add(name)
        yield name


def _fit_some(work: _Work, pictures: Sequence[Path], labels: Sequence[str]) -> tuple[list[FittedFace], list[Problem]]:
    """The faces of some pictures, and why others have none."""
    found, problems = _boxes_of(work, pictures)
    sizes: dict[Path, tuple[int, int]] = {}

    def read(path: Path) -> np.ndarray:
        picture = read_upright(path)
        sizes[path] = (picture.shape[1], picture.shape[0])
        return picture

    fits = fit(
        work.model,
        [pictures[number] for number in found.pictures],
        found.boxes,
        kind=list(found.kinds),
        passes=passes_from(work.detector) if work.boxes is None else 1,
        initialisations=work.options.initialisations,
        rotations=tuple(work.options.rotations),
        refine=work.options.refine,
        read=read,
    )
    faces, of_picture = [], dict.fromkeys(range(len(pictures)), 0)
    for row, number in enumerate(found.pictures):
        of_picture[number] += 1
        if row in fits.problems:
            problems.append(_problem(pictures[number], fits.problems[row]))
        else:
            label = f"{labels[number]}_{of_picture[number]}"
            faces.append(_fitted(fits, row, str(pictures[number]), label, sizes[pictures[number]]))
    return faces, problems


def _boxes_of(work: _Work, pictures: Sequence[Path]) -> tuple[_Boxes, list[Problem]]:
    """The faces of pictures: those given, or those that the detector finds; and why there are none."""
    if work.boxes is None:
        found = find_faces(pictures, work.detector)
        problems = [_problem(pictures[number], why) for number, why in found.problems.items()]
        return _Boxes(found.pictures.tolist(), found.boxes, found.kinds), problems
    given = [(number, box) for number, picture in enumerate(pictures) for box in work.boxes.get(picture.name, [])]
    known = {number for number, _ in given}
    missing = [picture for number, picture in enumerate(pictures) if number not in known]
    boxes = np.array([box for _, box in given]).reshape(-1, 4)
    problems = [Problem(str(picture), "no row with this file name in --boxes") for picture in missing]
    return _Boxes([number for number, _ in given], boxes, [work.options.box_kind] * len(given)), problems


def _problem(picture: Path, why: str) -> Problem:
    """A problem, which may begin with the name of its picture."""
    return Problem(str(picture), why.removeprefix(f"{picture}: "))


def _fitted(fits: Fits, row: int, image: str, label: str, size: tuple[int, int]) -> FittedFace:
    parts = {name: getattr(fits, name) for name in ("confidence", "pose", "scale", "landmarks_3d", "b")}
    told: dict[str, Any] = {name: _rounded(np.ravel(part[row])) for name, part in parts.items() if part is not None}
    alone = {name: numbers[0] for name, numbers in told.items() if name in ("confidence", "scale")}
    return FittedFace(
        image,
        label,
        size,
        fits.kinds[row],
        _rounded(fits.boxes[row]),
        _rounded(fits.landmarks[row].ravel()),
        **(told | alone),
    )


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    return tuple(np.round(values.astype(np.float64), _DIGITS).tolist())


def _draw(
    folder: Path, model: Model, pictures: Sequence[Path], labels: Sequence[str], faces: Sequence[FittedFace]
) -> list[Problem]:
    """An overlay for each picture with faces; returns what could not be written."""
    problems = []
    of_pictures: dict[str, list[FittedFace]] = {}
    for face in faces:
        of_pictures.setdefault(face.image, []).append(face)
    for picture, label in zip(pictures, labels, strict=True):
        if str(picture) not in of_pictures:
            continue
        try:
            canvas = read_image(picture)
            for face in of_pictures[str(picture)]:
                canvas = _drawn(canvas, model, face)
            write_image(folder / f"{label}.jpg", canvas)
        except ImageError as error:
            problems.append(_problem(picture, str(error)))
    return problems


def _drawn(canvas: np.ndarray, model: Model, face: FittedFace) -> np.ndarray:
    """A picture with a fit drawn over it, in 3D if the model has that."""
    landmarks, box = np.reshape(face.landmarks, (-1, 2)), np.array(face.box)
    if face.landmarks_3d is None or face.pose is None:
        return draw_landmarks(canvas, landmarks, model.scheme, box=box)
    # Of alignments, what is written in 2D: the landmarks that were found, at the aligned shape's depths.
    solid = np.column_stack([landmarks, np.reshape(face.landmarks_3d, (-1, 3))[:, 2]])
    return draw_head(canvas, solid, np.array(face.pose), model.scheme, box=box)
