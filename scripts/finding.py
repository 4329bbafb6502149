"""Faces found in photographs: by size, in groups and panoramas, turned, in dark ones, and how long it takes.

--photos is a folder of photographs with dlib's labels (``*.xml``: boxes and 68 points of all faces in a picture) and
with .pts files of one face; --data are pictures cut around one face each, which are pasted into groups and turned.
"""

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
from report import Report, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import add_datasets
from jaxfit.data import Detector, Search, detector_named, read_image, write_image
from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.detectors.detector import holds, overlap
from jaxfit.data.pts import read_pts
from jaxfit.evaluation.errors import nmed
from jaxfit.labels.datasets import read_datasets, shared_scheme
from jaxfit.labels.records import FaceRecord

BANDS = (0, 24, 40, 80, 160, 10000)  # widths of labelled boxes
PASTED = (24, 32, 48, 64, 96, 160, 250, 400)
CANVASES = (2000, 4000, 8000)
ANGLES = (0, 10, 20, 30, 45, 60, 90, 180)
LENGTHS = (500, 1000, 2000, 4000)
BRIGHTNESSES = (1.0, 0.25, 0.08, 0.04)
Find = Callable[[np.ndarray], Sequence[np.ndarray]]


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("--photos", required=True, metavar="DIR")
    add_datasets(parser)
    parser.add_argument("--model", default="face68")
    parser.add_argument("--faces", type=int, default=200, help="of --data that are pasted and turned")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    model = jaxfit.load(arguments.model)
    datasets = read_datasets(arguments.data, arguments.scheme)
    shared_scheme(datasets)
    faces = [face for dataset in datasets for face in dataset.faces if face.complete]
    chosen = [faces[number] for number in np.linspace(0, len(faces) - 1, arguments.faces).astype(int)]
    for name in arguments.parts:
        PARTS[name](report, model, Path(arguments.photos), chosen)


def photographs(report: Report, model: jaxfit.Model, photos: Path, faces: Sequence[FaceRecord]) -> None:
    """Recall and false boxes in photographs."""
    groups, singles = labelled_groups(photos), labelled_singles(photos)
    rows = []
    found_by: dict[str, list[list[np.ndarray]]] = {}
    for name, find in finders().items():
        found_by[name] = [list(find(read_image(path))) for path in [*groups, *singles]]
        row: dict[str, object] = {"detector": name}
        truths = [*groups.values(), *singles.values()]
        widths = np.array([box[2] for truth in truths for box in truth])
        hits = np.array(
            [
                any(same(box, each) for each in found)
                for truth, found in zip(truths, found_by[name], strict=True)
                for box in truth
            ]
        )
        for low, high in itertools.pairwise(BANDS):
            inside = (widths >= low) & (widths < high)
            row[band(low, high)] = f"{hits[inside].sum()} of {inside.sum()}" if inside.any() else "-"
        row["all"] = f"{hits.sum()} of {len(hits)}"
        false = [
            (path, box)
            for (path, truth), found in zip(groups.items(), found_by[name], strict=False)
            for box in found
            if not any(same(each, box) for each in truth)
        ]
        row["false"] = len(false)
        if not name.endswith("itself"):
            fits = jaxfit.fit(model, [*groups], detector=name)
            names = [str(path) for path in groups]
            wrong = [
                row_
                for row_, (number, box) in enumerate(zip(fits.pictures, fits.boxes, strict=True))
                if not any(same(each, box) for each in groups[Path(names[number])])
            ]
            row["false, but ok"] = int(fits.ok[wrong].sum())
        rows.append(row)
    columns = {"detector": ""} | {band(low, high): "" for low, high in itertools.pairwise(BANDS)}
    report.table(
        rows,
        columns | {"all": "", "false": "", "false, but ok": ""},
        above=f"Labelled faces found, by the width of their box in pixels, in {len(groups)} photographs of several "
        f"people and {len(singles)} of one; false boxes are counted where all faces are labelled. *Itself*: the "
        "library's own detector, in Haar's case the frontal cascade on the picture as it is, in dlib's on the picture "
        "enlarged once.",
    )
    for name in ("haar", "dlib"):
        if f"{name} itself" in found_by:
            pairs = zip(found_by[f"{name} itself"], found_by[name], strict=True)
            shared = [any(same(box, each) for each in ours) for theirs, ours in pairs for box in theirs]
            report.add(f"Of {len(shared)} boxes of {name} itself, {name} finds {sum(shared)}.")


def labelled_groups(photos: Path) -> dict[Path, list[np.ndarray]]:
    """The boxes (4,) of all faces of each picture that dlib's files label."""
    pictures: dict[Path, list[np.ndarray]] = {}
    for path in sorted(photos.glob("*.xml")):
        for image in ElementTree.parse(path).iter("image"):
            boxes = [
                [float(box.attrib[side]) for side in ("left", "top", "width", "height")] for box in image.iter("box")
            ]
            pictures[photos / image.attrib["file"]] = [np.array(box) for box in boxes]
    return pictures


def labelled_singles(photos: Path) -> dict[Path, list[np.ndarray]]:
    """The square around the one labelled face of each picture with a .pts file."""
    return {path.with_suffix(".jpg"): [bounding_square(read_pts(path))] for path in sorted(photos.glob("*.pts"))}


def finders() -> dict[str, Find]:
    """What finds the boxes of a picture: our detectors at their defaults, and the libraries' own."""
    ours: dict[str, Find] = {}
    for name in ("yunet", "haar", "dlib"):
        try:
            ours[name] = boxes_of(detector_named(name))
        except jaxfit.InputError:
            print(f"without {name}, which is not installed", file=sys.stderr)
    ours["haar itself"] = haar_itself
    if "dlib" in ours:
        ours["dlib itself"] = dlib_itself
    return ours


def boxes_of(detector: Detector) -> Find:
    return lambda rgb: [face.box for face in detector(rgb)]


def haar_itself(rgb: np.ndarray) -> list[np.ndarray]:
    """The frontal cascade's finds in a picture as it is."""
    cascade = cv2.CascadeClassifier(str(Path(cv2.__file__).parent / "data" / "haarcascade_frontalface_alt2.xml"))
    return list(
        np.array(cascade.detectMultiScale(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), 1.1, 3, minSize=(24, 24)), float)
    )


def dlib_itself(rgb: np.ndarray) -> list[np.ndarray]:
    """dlib's finds in a picture that is enlarged once."""
    import dlib

    found = dlib.get_frontal_face_detector()(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), 1)
    return [np.array([box.left(), box.top(), box.width(), box.height()], float) for box in found]


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether boxes (4,) are of one face: each holds the other's middle, and neither is three times as wide."""
    near = holds(one, box_centre(other)) and holds(other, box_centre(one))
    return bool(near and 1 / 3 < one[2] / other[2] < 3) or overlap(one, other) > 0.3


def band(low: int, high: int) -> str:
    return f"{low} … {high}" if high < BANDS[-1] else f"{low} …"


def groups(report: Report, model: jaxfit.Model, photos: Path, faces: Sequence[FaceRecord]) -> None:
    """Recall against the size of faces that are pasted into large pictures."""
    rows = []
    for longest in CANVASES:
        for search in (Search(), Search(smallest=PASTED[0])):
            detector = detector_named("yunet", search)
            row: dict[str, object] = {"picture": f"{longest} × {longest * 3 // 4}"}
            row["smallest"] = f"{search.smallest_in((longest * 3 // 4, longest)):.0f}" + " (default)" * (
                search == Search()
            )
            seconds, false = 0.0, 0
            for width in PASTED:
                canvas, truth = pasted(faces, width, longest, np.random.default_rng(width))
                begin = time.perf_counter()
                found = [face.box for face in detector(canvas)]
                seconds += time.perf_counter() - begin
                row[f"{width}"] = float(np.mean([any(same(box, each) for each in found) for box in truth]))
                false += sum(not any(same(each, box) for each in truth) for box in found)
            row |= {"false": false, "s": seconds / len(PASTED)}
            rows.append(row)
    columns = {"picture": "", "smallest": ""} | {f"{width}": ".1%" for width in PASTED} | {"false": "d", "s": ".2f"}
    report.table(
        rows,
        columns,
        above=f"Faces of {', '.join(map(str, PASTED))} pixels (width of the square around the landmarks), up to 60 of "
        "one size pasted into a picture of noise: share found by YuNet, false boxes in eight such pictures, seconds "
        "for one.",
    )
    panorama: dict[str, object] = {}
    for place in (0, 15000, 39000):
        canvas = noise(2000, 40000, np.random.default_rng(0))
        square = paste(canvas, faces[0], 230, place, 900)
        begin = time.perf_counter()
        hits = [same(square, face.box) for face in detector_named("yunet")(canvas)]
        panorama[f"face at {place}"] = f"found: {sum(hits)}, false: {len(hits) - sum(hits)}"
        panorama["s"] = f"{time.perf_counter() - begin:.2f}"
    report.table(
        [panorama], dict.fromkeys(panorama, ""), above="A panorama of 40,000 × 2,000 pixels with a face of 230."
    )


def noise(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """A picture, uint8 (H, W, 3), of noise at all scales."""
    picture = np.full((height, width, 3), 110, np.float32)
    for step in (4, 16, 64, 256):
        small = rng.normal(0, 14, (height // step + 2, width // step + 2, 3)).astype(np.float32)
        picture += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(picture, 0, 255).astype(np.uint8)


def paste(canvas: np.ndarray, face: FaceRecord, width: float, left: int, top: int) -> np.ndarray:
    """Paste a face's picture so that the square around its landmarks is so wide, its corner at least there; returns the
    square (4,)."""
    square = bounding_square(face.landmarks)
    scale = width / square[2]
    low = np.floor(np.maximum(square[:2] - 0.5 * square[2], 0)).astype(int)
    high = np.ceil(square[:2] + 1.5 * square[2]).astype(int)
    part = read_image(face.image, exif=False)[low[1] : high[1], low[0] : high[0]]
    size = np.maximum(1, np.round(np.array(part.shape[1::-1]) * scale)).astype(int)
    size = np.minimum(size, [canvas.shape[1] - left, canvas.shape[0] - top])
    part = cv2.resize(part, tuple(size.tolist()), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    canvas[top : top + size[1], left : left + size[0]] = part
    return np.array([*((square[:2] - low) * scale + [left, top]), width, width])


def pasted(
    faces: Sequence[FaceRecord], width: int, longest: int, rng: np.random.Generator
) -> tuple[np.ndarray, list[np.ndarray]]:
    """A picture of noise with up to 60 faces of one size, and their squares."""
    canvas, truth = noise(longest * 3 // 4, longest, rng), []
    step = int(2.4 * width)
    places = [(x, y) for y in range(0, canvas.shape[0] - step, step) for x in range(0, canvas.shape[1] - step, step)]
    for number, place in enumerate(rng.permutation(len(places))[:60]):
        truth.append(paste(canvas, faces[(number * 7) % len(faces)], width, *places[place]))
    return canvas, truth


def turned(report: Report, model: jaxfit.Model, photos: Path, faces: Sequence[FaceRecord]) -> None:
    """Share of faces with small errors in turned pictures, no boxes given."""
    rows = []
    pictures = [read_image(face.image, exif=False) for face in faces]
    for degrees in ANGLES:
        row: dict[str, object] = {"degrees": f"±{degrees}" if degrees % 180 else f"{degrees}"}
        for name, search in (("default", Search()), ("any rotation", Search(any_rotation=True))):
            good = []
            for sign in (1, -1) if degrees % 180 else (1,):
                turned_pictures, truths = [], []
                for picture, face in zip(pictures, faces, strict=True):
                    there = turn(picture.shape, sign * degrees)
                    size = there[1]
                    turned_pictures.append(cv2.warpAffine(picture, there[0], size, borderMode=cv2.BORDER_REPLICATE))
                    truths.append(face.landmarks @ there[0][:, :2].T + there[0][:, 2])
                fits = jaxfit.fit(model, turned_pictures, search=search)
                errors = np.full(len(faces), np.inf)
                for number, landmarks in zip(fits.pictures, fits.landmarks, strict=True):
                    error = float(nmed(landmarks[None], truths[number][None], model.scheme, "outer")[0])
                    errors[number] = min(errors[number], error)
                good.append(np.mean(errors < 0.08))
            row[name] = float(np.mean(good))
        rows.append(row)
    report.table(
        rows,
        {"degrees": "", "default": ".1%", "any rotation": ".1%"},
        above=f"{len(faces)} pictures of one face, turned: share of faces with NMED < 0.08, no boxes given, {model!r}.",
    )


def turn(shape: Sequence[int], degrees: float) -> tuple[np.ndarray, tuple[int, int]]:
    """How a picture (H, W, …) is turned clockwise into one that holds it whole, (2, 3), and that one's size."""
    height, width = shape[:2]
    there = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -degrees, 1)
    cos, sin = np.abs(there[0, :2])
    size = (int(np.ceil(width * cos + height * sin)), int(np.ceil(width * sin + height * cos)))
    there = there + np.array([[0, 0, (size[0] - width) / 2], [0, 0, (size[1] - height) / 2]])
    return there, size


def dark(report: Report, model: jaxfit.Model, photos: Path, faces: Sequence[FaceRecord]) -> None:
    """Share of faces found in dark pictures, as they are and brightened."""
    detector, rows = detector_named("yunet"), []
    for brightness in BRIGHTNESSES:
        row: dict[str, object] = {"brightness": brightness}
        for name, brighten in (("as it is", None), ("equalised", equalised), ("stretched", stretched)):
            hits, others = 0, 0
            for face in faces:
                picture = np.round(brightness * read_image(face.image, exif=False)).astype(np.uint8)
                boxes = [each.box for each in detector(picture)]
                if not boxes and brighten is not None:
                    boxes = [each.box for each in detector(brighten(picture))]
                found = [same(bounding_square(face.landmarks), box) for box in boxes]
                hits, others = hits + any(found), others + found.count(False)
            row |= {name: f"{hits / len(faces):.1%}", f"{name}, others": others}
        rows.append(row)
    report.table(
        rows,
        {"brightness": ".0%"} | dict.fromkeys([name for name in rows[0] if name != "brightness"], ""),
        above=f"{len(faces)} pictures of one face, darkened: share of faces found by YuNet, and other finds; where "
        "nothing is found in the picture as it is, also in the equalised one (its histogram), or in the stretched one "
        "(so that 1 in 100 pixels is white).",
    )


def equalised(picture: np.ndarray) -> np.ndarray:
    """A picture, uint8 (H, W, 3), whose lightness has an even histogram."""
    lightness, *colours = cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb))
    return cv2.cvtColor(cv2.merge([cv2.equalizeHist(lightness), *colours]), cv2.COLOR_YCrCb2RGB)


def stretched(picture: np.ndarray) -> np.ndarray:
    """A picture, uint8 (H, W, 3), made so bright that 1 in 100 values is white."""
    return np.clip(picture * (255 / max(1.0, float(np.quantile(picture, 0.99)))), 0, 255).astype(np.uint8)


def times(report: Report, model: jaxfit.Model, photos: Path, faces: Sequence[FaceRecord]) -> None:
    """Milliseconds a photograph, for finding and for all else."""
    detector, rows = detector_named("yunet"), []
    paths = [*labelled_groups(photos), *labelled_singles(photos)]
    with tempfile.TemporaryDirectory() as folder:
        for longest in LENGTHS:
            files = list(resized(paths, longest, Path(folder)))
            jaxfit.fit(model, files[:8])
            pictures = [read_image(file) for file in files]
            finding = median(partial(find_all, detector, pictures))
            whole = median(partial(jaxfit.fit, model, files))
            rows.append(
                {
                    "longer side": longest,
                    "finding, one thread": 1000 * finding / len(files),
                    "all, from files": 1000 * whole / len(files),
                    "pictures a second": len(files) / whole,
                }
            )
    report.table(
        rows,
        {"longer side": "d", "finding, one thread": ".1f", "all, from files": ".1f", "pictures a second": ".0f"},
        above=f"Milliseconds a picture, {len(paths)} photographs resized; medians of three runs after one.",
    )


def find_all(detector: Detector, pictures: Sequence[np.ndarray]) -> None:
    for picture in pictures:
        detector(picture)


def resized(paths: Iterable[Path], longest: int, folder: Path) -> Iterable[Path]:
    for path in paths:
        picture = read_image(path)
        scale = longest / max(picture.shape)
        size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
        way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        file = folder / f"{longest}-{path.name}"
        write_image(file, cv2.resize(picture, size, interpolation=way))
        yield file


def median(work: Callable[[], object]) -> float:
    seconds = []
    work()
    for _ in range(3):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


PARTS = {"photographs": photographs, "groups": groups, "turned": turned, "dark": dark, "times": times}


if __name__ == "__main__":
    sys.exit(main())
