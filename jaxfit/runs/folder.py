"""Fitting a folder of pictures, however many, into tables, overlays and other formats; a stopped run goes on."""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, starmap
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

import jaxfit
from jaxfit.data.boxes import GivenBox, boxes_of_pictures
from jaxfit.data.contact_sheet import write_contact_sheet
from jaxfit.data.detectors import all_rough
from jaxfit.data.inputs import require_no_inputs, same_files
from jaxfit.data.limits import counted_together, most_megapixels
from jaxfit.data.locks import held
from jaxfit.data.names import each_once, plain, table_path, unique_names
from jaxfit.data.outputs import (
    MANIFEST,
    not_written,
    replace_results,
    require_own_folder,
    write_csv,
)
from jaxfit.data.overlays import box_of, draw_name, draw_row
from jaxfit.data.pictures import read_image, write_image
from jaxfit.data.rows import PROBLEM, Row, Rows, table_text, table_values
from jaxfit.data.threads import in_order, reading_threads
from jaxfit.data.writers import DEFAULT_FORMATS, PTS, WRITERS, require_pyarrow
from jaxfit.errors import ImageError, InputError
from jaxfit.fitting.given_boxes import read_known_boxes
from jaxfit.fitting.pipeline import Fitting, Pipeline, require_fitting
from jaxfit.fitting.place import Placing, place_heads
from jaxfit.fitting.refine import refine, require_refinable
from jaxfit.fitting.sources import Source
from jaxfit.fitting.stream import stream
from jaxfit.heads.with_heads import ensure_heads
from jaxfit.models.files import DEFAULT_MODEL, load
from jaxfit.models.model import Model
from jaxfit.runs.run_folder import RunFolder, digest, file_digests, run_files
from jaxfit.schemes.scheme import Scheme
from jaxfit.types import Progress, silent

# Pictures that are kept together when they are done: what a killed run loses at most.
_CHUNK = 256
_COMMAND, _OVERLAYS = "jaxfit fit", "overlays"
# What earlier versions wrote, without a manifest.
_RESULTS = (
    *("landmarks.csv", "heads.csv", "landmarks.parquet", "heads.parquet", "faces.jsonl", "keypoints.json"),
    *("landmarks.tps", "landmarks.xml", "problems.csv", "doubtful.csv", "contact-sheet.jpg"),
)
_NO_ROW = "no row with this file name in the boxes"
_OTHER_PATH = "no row with this path in the boxes, only"


@dataclass(frozen=True)
class FolderRun:
    """What a run over pictures does, and where its results go.

    Attributes:
        out: the folder of the results, made if needed.
        model: a bundled model's name, or a model file.
        fitting: how faces are found, by a detector that comes by name, and fitted.
        boxes: a CSV file of face boxes with the columns image, x, y, width and height, and rotation if faces are
            turned, instead of a detector; ``landmarks.csv`` of another run is such a file, and where a rough detector
            drew all of its boxes, they are fitted in two passes as the detector's are. ``image`` is a path,
            absolute or relative to the file, to one of ``folders`` or to the working folder; or the end of one, such as
            a bare file name, where only one picture's path ends so.
        folders: that the pictures were found in.
        box_kind: what drew those boxes; None takes what the file's column box says, and squares where it says nothing.
        unshift: move fits of models whose labels lay beside what they mark onto it (``Model.unshifted``).
        heads: find heads with 2D models, as ``jaxfit.with_heads`` does.
        refine: refine 3D alignments, as ``jaxfit.refine`` does.
        placing: the camera that heads are placed before, as ``jaxfit.place_heads`` does; 2D models then find heads.
        formats: what to write, among ``jaxfit.data.writers.WRITERS``.
        overlays: write pictures with the faces drawn over them.
        contact_sheet: write one picture with many faces, the doubtful ones first.
        min_confidence: write faces whose confidence is lower to ``doubtful.csv`` instead of the other tables; None
            writes all to the tables, whose column ``ok`` says which are more likely good than not.
        overwrite: begin anew if there is an unfinished run, and replace results of another command or without a
            manifest.
    """

    out: str | Path
    model: str | Path = DEFAULT_MODEL
    fitting: Fitting = field(default_factory=Fitting)
    boxes: str | Path | None = None
    folders: tuple[str | Path, ...] = ()
    box_kind: str | None = None
    unshift: bool = False
    heads: bool = False
    refine: bool = False
    placing: Placing | None = None
    formats: tuple[str, ...] = DEFAULT_FORMATS
    overlays: bool = True
    contact_sheet: bool = False
    min_confidence: float | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        require_fitting(self.fitting)

    def files(self) -> dict[str, Path]:
        """The files beside the pictures that the run reads, by what they are."""
        return run_files(self.model, self.fitting, self.boxes)

    def settings(self, pictures: Sequence[Path]) -> dict[str, Any]:
        """What has to be the same for a stopped run to go on; JSON values."""
        # Absolute, too: the same names in another working folder are other pictures.
        names = b"\0".join(os.fsencode(name) for path in pictures for name in (path, path.absolute()))
        return {
            "jaxfit": jaxfit.__version__,
            "model": str(self.model),
            **self.fitting.settings(),
            "box_kind": self.box_kind,
            "folders": list(map(str, self.folders if self.boxes else ())),
            "unshift": self.unshift,
            "heads": self.heads,
            "refine": self.refine,
            "placing": None if self.placing is None else self.placing.settings(),
            "overlays": self.overlays,
            "max_megapixels": most_megapixels(),
            **file_digests(self.model, self.files()),
            "pictures": len(pictures),
            "pictures' names": digest(names),
        }


class Unfit(NamedTuple):
    """A picture without a fit, or with a face that has none, and why."""

    image: str
    why: str


@dataclass(frozen=True)
class FolderReport:
    """What a run has done.

    Attributes:
        pictures: how many there were.
        resumed: how many of them an earlier run had done.
        faces: how many were fitted.
        doubtful: how many of them are more likely bad than good, by the model's confidence.
        problems: of pictures without a fit, and of faces in them.
        unused: names of pictures in the file of boxes that were not given.
        left_out: pictures that were given, but that an earlier run wrote to the folder of the results.
        written: files and folders, in the folder of the results.
        set_apart: how many faces are in ``doubtful.csv`` instead of the tables, because their confidence is below
            ``min_confidence``.
        replaced: a sentence about a finished run of other settings whose results were in the folder; empty if there
            was none.
    """

    pictures: int
    resumed: int
    faces: int
    doubtful: int
    problems: tuple[Unfit, ...]
    unused: tuple[str, ...]
    left_out: tuple[Path, ...]
    written: tuple[Path, ...]
    set_apart: int
    replaced: str


def fit_folder(run: FolderRun, pictures: Sequence[str | Path], *, progress: Progress = silent) -> FolderReport:
    """Fit pictures into a folder of results: tables and other formats, overlays, and ``problems.csv``.

    The folder is the run's own: ``manifest.json`` says what was written, by what and when, and files of an earlier run
    that this one does not write are removed.

    Pictures are done in chunks that are kept in ``.unfinished``, each as a whole or not at all: a run that was stopped
    goes on when it is started again with the same settings and pictures, and gives the same files. Chunks of pictures
    that have changed since are done anew. One process at a time writes to the folder, and never over an input.

    Args:
        run: what to do; its folder of results may hold those of an earlier run, which are replaced.
        pictures: files, as ``jaxfit.data.find_images`` finds them in folders; one under several paths is fitted once.
        progress: called with the stage's name, pictures done and pictures in all.

    Raises:
        InputError: a setting is wrong; the folder holds an unfinished run of other settings, results of another command
            or without a manifest, is being written by another process, or cannot be written to; or a picture or
            another file that was given would be written over.
        ModelError: no such model.
    """
    model = load(run.model)
    model = model.unshifted() if run.unshift else model
    model = ensure_heads(model) if run.heads or run.placing is not None else model
    pipeline, named = _pipeline(run, model)
    with held(run.out, _COMMAND):
        return _fit_held(run, pipeline, named, each_once(pictures), progress)


def _fit_held(
    run: FolderRun, pipeline: Pipeline, named: "_NamedBoxes | None", pictures: Sequence[Path], progress: Progress
) -> FolderReport:
    """What `fit_folder` does, in a folder that nobody else writes to."""
    out, model = Path(run.out), pipeline.model
    unfinished = RunFolder(out)
    if not run.overwrite:
        _require_own(out, unfinished)
    left_out = same_files(pictures, unfinished.written())
    files = [path for path in pictures if path not in left_out]
    labels = list(unique_names(files))
    overlays = [f"{_OVERLAYS}/{label}.jpg" for label in labels] if run.overlays else []
    require_no_inputs(_outputs(out, overlays, labels), [*files, *run.files().values()])
    if run.overwrite:
        unfinished.discard()
    boxes, unused = _boxes_of(run, named, files)
    settings = run.settings(files)
    chunks = [files[first : first + _CHUNK] for first in range(0, len(files), _CHUNK)]
    unfinished.begin(settings, chunks, [*overlays, *_RESULTS])
    resumed = _fit_missing(run, pipeline, boxes, unused, chunks, labels, unfinished, progress)
    modes = None if model.space_3d is None else model.space_3d.modes
    fitted = Rows(
        model.scheme,
        modes,
        model.confidence is not None,
        unfinished.faces,
        run.placing is not None,
        model.uncertainty is not None,
    )
    rows = fitted if run.min_confidence is None else fitted.only(lambda row: row["confidence"] >= run.min_confidence)
    progress("writing results", 0, 1)
    written = list(chain.from_iterable(WRITERS[name](out, rows) for name in dict.fromkeys(run.formats)))
    problems = [*(Unfit(row["image"], row[PROBLEM]) for row in unfinished.problems()), *starmap(Unfit, rows.failures)]
    write_csv(out / "problems.csv", ["image", "problem"], ((table_path(path), plain(why)) for path, why in problems))
    set_apart = 0
    if run.min_confidence is not None:
        set_apart = sum(1 for row in fitted if row["confidence"] < run.min_confidence)
        below = fitted.only(lambda row: row["confidence"] < run.min_confidence)
        values = ([table_text(value) for value in table_values("landmarks", row)] for row in below)
        write_csv(out / "doubtful.csv", fitted.tables()["landmarks"], values)
        written.append("doubtful.csv")
    if run.contact_sheet:
        problems += starmap(Unfit, write_contact_sheet(out / "contact-sheet.jpg", fitted))
        written.append("contact-sheet.jpg")
    ok = Counter(row["ok"] for row in fitted)
    written += ["problems.csv", *([_OVERLAYS] if run.overlays else [])]
    others = _unaccounted(out) if run.overwrite else []
    of_picture = dict(zip(map(str, files), labels, strict=True))
    said = settings | {
        "formats": list(run.formats),
        "contact_sheet": run.contact_sheet,
        "min_confidence": run.min_confidence,
    }
    replaced = replace_results(out, _COMMAND, _files(out, written, rows, fitted, of_picture), said, others)
    written.append(MANIFEST)
    unfinished.discard()
    paths = tuple(out / name for name in written)
    return FolderReport(
        pictures=len(files),
        resumed=resumed,
        faces=ok.total(),
        doubtful=ok[False],
        problems=tuple(problems),
        unused=tuple(unused),
        left_out=tuple(left_out),
        written=paths,
        set_apart=set_apart,
        replaced=replaced,
    )


def _outputs(out: Path, overlays: Sequence[str], labels: Sequence[str]) -> Iterator[Path]:
    """What a run may write over in its folder."""
    yield from (out / name for name in (*_RESULTS, MANIFEST, *overlays))
    # How many faces pictures have is not known yet: what is there is looked at.
    with suppress(FileNotFoundError, NotADirectoryError), os.scandir(out / PTS) as entries:
        yield from map(Path, entries)


def _require_own(out: Path, unfinished: RunFolder) -> None:
    """Check that a folder holds no results but those of earlier runs like this one.

    Raises:
        InputError: it holds others, or such as no manifest accounts for.
    """
    try:
        require_own_folder(out, _COMMAND)
    except InputError as error:
        raise InputError(f"{error}, or overwrite (--overwrite) to replace them") from None
    if not unfinished.begun and not (out / MANIFEST).exists() and (strange := _unaccounted(out)):
        raise InputError(
            f"{out} holds {strange[0]}, which no {MANIFEST} lists, as after a run of an earlier version; use another "
            "--out, or overwrite (--overwrite) to replace such results"
        )


def _unaccounted(out: Path) -> list[str]:
    """Files in a folder that are called like results."""
    return [name for name in _RESULTS if (out / name).is_file()]


def _files(out: Path, written: Sequence[str], rows: Rows, drawn: Rows, labels: Mapping[str, str]) -> Iterator[str]:
    """The files that this run wrote: those of ``rows`` and, in overlays, of ``drawn``, whose pictures have ``labels``.

    Not all that is in the folders: others may have put files there, which no later run may take for its own.
    """
    for name in written:
        if name == PTS:
            yield from _there(out, (f"{PTS}/{row['face']}.pts" for row in rows))
        elif name == _OVERLAYS:
            pictures = dict.fromkeys(row["image"] for row in drawn)
            yield from _there(out, (f"{_OVERLAYS}/{labels[picture]}.jpg" for picture in pictures))
        else:
            yield name


def _there(out: Path, names: Iterable[str]) -> Iterator[str]:
    return (name for name in names if (out / name).is_file())


_NamedBoxes = Mapping[str, Sequence[GivenBox]]
_Boxes = Mapping[Path, Sequence[GivenBox]]


def _pipeline(run: FolderRun, model: Model) -> tuple[Pipeline, _NamedBoxes | None]:
    """How pictures are fitted, and the boxes of the file, if there is one; wrong settings stop before the work."""
    if run.refine:
        require_refinable(model)
    if run.placing is not None:
        run.placing.unit(model)
    if "parquet" in run.formats:
        require_pyarrow()
    if unknown := [name for name in run.formats if name not in WRITERS]:
        raise InputError(f"expected formats among {', '.join(WRITERS)}; got {unknown[0]!r}")
    if run.min_confidence is not None and not 0 <= run.min_confidence <= 1:
        raise InputError(
            f"min confidence: expected a number from 0 to 1, such as 0.5, which leaves out fits that are more "
            f"likely bad than good; got {run.min_confidence}"
        )
    if run.min_confidence is not None and model.confidence is None:
        raise InputError(
            f"min confidence: the model {run.model} has no confidence; leave it out, or take a model that has one"
        )
    run.fitting.settings()  # which only detectors that come by name have
    if run.boxes is not None:
        run.fitting.require_given_boxes()
    named = read_known_boxes(run.boxes, run.box_kind, model)
    if named is None:
        return run.fitting.pipeline(model), None
    return run.fitting.pipeline_in_boxes(model, all_rough(box.kind for boxes in named.values() for box in boxes)), named


def _boxes_of(run: FolderRun, named: _NamedBoxes | None, files: Sequence[Path]) -> tuple[_Boxes | None, list[str]]:
    """The boxes of each picture, None if they are looked for, and the names in the file that no picture has."""
    if named is None or run.boxes is None:
        return None, []
    try:
        return boxes_of_pictures(named, files, (Path(run.boxes).parent, *run.folders))
    except InputError as error:
        raise InputError(f"{run.boxes}: {error}") from None


def _fit_missing(
    run: FolderRun,
    pipeline: Pipeline,
    boxes: _Boxes | None,
    unused: Sequence[str],
    chunks: Sequence[Sequence[Path]],
    labels: Sequence[str],
    unfinished: RunFolder,
    progress: Progress,
) -> int:
    """Fit the chunks that are not there, and keep each; returns how many pictures were there."""
    model, overlays = pipeline.model, Path(run.out) / _OVERLAYS
    if run.overlays:
        overlays.mkdir(exist_ok=True)
    elsewhere = {PurePath(name).name: name for name in unused}
    missing = [number for number in range(len(chunks)) if not unfinished.has(number)]
    sources = ([_source(path, boxes) for path in chunks[number]] for number in missing)
    left = sum(len(chunks[number]) for number in missing)
    pictures = sum(map(len, chunks))
    done_before = pictures - left

    def report(stage: str, done: int, total: int) -> None:
        progress(stage, done_before + done, pictures)

    with closing(stream(pipeline, sources, left, report)) as results:
        for number, fits in zip(missing, results, strict=True):
            named = labels[number * _CHUNK : (number + 1) * _CHUNK]
            fits = refine(model, fits) if run.refine else fits
            fits = fits if run.placing is None else place_heads(model, fits, run.placing)
            rows = list(fits.rows(named, problems=True))
            if boxes is not None:  # of pictures without any row that is said
                rows = [row if "face" in row else row | {PROBLEM: _no_row(row["image"], elsewhere)} for row in rows]
            if run.overlays:
                rows += _draw(overlays, model.scheme, chunks[number], named, rows)
            unfinished.put(number, rows)
    return done_before


def _no_row(image: str, elsewhere: Mapping[str, str]) -> str:
    """That there is no box for a picture, and which row of the same file name there is ``elsewhere``."""
    other = elsewhere.get(PurePath(image).name)
    return _NO_ROW if other is None else f"{_OTHER_PATH} {other}"


def _source(path: Path, boxes: _Boxes | None) -> Source:
    if boxes is None:
        return Source(path, str(path))
    given = boxes.get(path, [])
    array = np.array([each.box for each in given]).reshape(-1, 4)
    kinds = tuple(each.kind for each in given)
    return Source(path, str(path), array, kinds, np.array([each.rotation for each in given]))


def _draw(
    folder: Path, scheme: Scheme, pictures: Sequence[Path], labels: Sequence[str], rows: Sequence[Row]
) -> list[Row]:
    """Draw an overlay for each picture with faces, in threads; returns rows that say what could not be written."""
    faces: dict[str, list[Row]] = {}
    for row in rows:
        if PROBLEM not in row:
            faces.setdefault(row["image"], []).append(row)

    def draw(picture: Path, label: str) -> list[Row]:
        path = folder / f"{label}.jpg"
        try:
            with counted_together():
                canvas = read_image(picture)
                for number, row in enumerate(faces[str(picture)], 1):
                    canvas = draw_row(canvas, row, scheme)
                    name = str(number) if row["ok"] else f"{number}: {row['confidence']:.2f}"
                    canvas = draw_name(canvas, name, box_of(row), row["ok"])
                write_image(path, canvas)
        except ImageError as error:
            return [{"image": str(picture), PROBLEM: str(error).removeprefix(f"{picture}: ")}]
        except (OSError, InputError) as error:
            return [{"image": str(picture), PROBLEM: not_written(path, error)}]
        return []

    work: Iterator[Callable[[], list[Row]]] = (
        partial(draw, picture, label) for picture, label in zip(pictures, labels, strict=True) if str(picture) in faces
    )
    with closing(in_order(work, reading_threads(len(faces)))) as drawn:
        return list(chain.from_iterable(drawn))
