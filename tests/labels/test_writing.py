"""Labels written in one format and read in another are the same, as far as both can hold them."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from written_labels import write_picture

from jaxfit.cli.main import main
from jaxfit.data.writers.annotations import ANNOTATION_FORMATS
from jaxfit.errors import InputError
from jaxfit.labels.datasets import read_dataset
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.labels.writing import parse_target, write_labels
from jaxfit.schemes.known import scheme_named
from jaxfit.schemes.scheme import Scheme

NAMES = ("=a b.png", "é & <'\">.png", "back\\slash.png")
FILES = {name: f"l{format.suffix}" for name, format in ANNOTATION_FORMATS.items()}


def objects(folder: Path, scheme: Scheme) -> Dataset:
    """Objects in pictures of awkward names: with and without boxes, scales, missing and hidden points."""
    faces = []
    for number, name in enumerate(NAMES):
        write_picture(folder / name)
        landmarks = np.arange(2.0 * scheme.count).reshape(-1, 2) + 0.125 * number + 3
        present = np.arange(scheme.count) != number
        faces.append(
            FaceRecord(
                image=folder / name,
                landmarks=np.where(present[:, None], landmarks, np.nan),
                present=present,
                visible=present & (np.arange(scheme.count) != 3),
                box=np.array([1.0, 2, 20, 15]) if number != 1 else None,
                pose=None,
                subject="person" if number == 2 else Path(name).stem,
                face=f"object {number}",
                scale=0.04 if number else None,
            )
        )
    return Dataset("tests:none", scheme, tuple(faces))


SCHEMES = [
    scheme_named("points4"),
    Scheme("points4", 4, names=("tip", "root & base", "a_x", 'the "fourth"'), lines=((0, 1), (1, 2))),
    scheme_named("aflw21"),
]


# All formats hold numbered points; others are for those that hold names.
ROUND_TRIPS = [(first, second, SCHEMES[0]) for first in FILES for second in FILES] + [
    (first, second, scheme)
    for first in ("imglab", "coco", "csv")
    for second in ("imglab", "coco", "csv")
    for scheme in SCHEMES[1:]
]


@pytest.mark.parametrize(("first", "second", "scheme"), ROUND_TRIPS, ids=lambda value: getattr(value, "name", value))
def test_round_trips(first: str, second: str, scheme: Scheme, tmp_path: Path) -> None:
    given = dataset = objects(tmp_path, scheme)
    for format in (first, second):
        path = tmp_path if format == "pts" else tmp_path / FILES[format]
        assert write_labels(dataset, format, path)[0] == len(given.faces)
        dataset = read_dataset(f"{format}:{path}")
        assert not dataset.problems
    keeps = ANNOTATION_FORMATS[first].keeps & ANNOTATION_FORMATS[second].keeps
    whole = "imglab" in (first, second)  # dlib knows whole pixels only
    found = {face.image.name: face for face in dataset.faces}
    assert found.keys() == set(NAMES)
    for face in given.faces:
        other = found[face.image.name]
        assert dataset.scheme.count == scheme.count
        points, wanted = other.landmarks, face.landmarks
        if scheme.names and "imglab" in (first, second):
            wanted = wanted[np.argsort(scheme.names)]  # parts come in the order of their names
        np.testing.assert_array_equal(np.isnan(points), np.isnan(wanted))
        np.testing.assert_allclose(points, wanted, atol=0.5 if whole else 2e-3)
        if "box" in keeps and face.box is not None:
            assert other.box is not None
            np.testing.assert_allclose(other.box, face.box)
        if "scale" in keeps:
            assert other.scale == face.scale
        if "hidden" in keeps:
            np.testing.assert_array_equal(other.visible, face.visible)
        if "subject" in keeps:
            assert other.subject == face.subject


@pytest.mark.parametrize("format", FILES)
def test_what_a_format_cannot_hold_is_said(format: str, tmp_path: Path) -> None:
    path = tmp_path if format == "pts" else tmp_path / FILES[format]
    _, problems = write_labels(objects(tmp_path, SCHEMES[0]), format, path)
    lost = {"box": "boxes: those of 2", "hidden": "hidden points: those of 3", "scale": "scales: those of 2"}
    lost["subject"] = "subjects: those of 1"
    for key, words in lost.items():
        assert any(words in problem for problem in problems) == (key not in ANNOTATION_FORMATS[format].keeps), problems


def test_one_object_a_pts_file(tmp_path: Path) -> None:
    dataset = objects(tmp_path, SCHEMES[0])
    twice = replace(dataset, faces=(*dataset.faces, replace(dataset.faces[0], face="another")))
    written, problems = write_labels(twice, "pts", tmp_path)
    assert written == 3
    assert any("holds one object" in problem for problem in problems)


@pytest.mark.parametrize("format", ["tps", "ml-morph"])
def test_pictures_of_unknown_height_are_said(format: str, tmp_path: Path) -> None:
    dataset = objects(tmp_path, SCHEMES[0])
    (tmp_path / NAMES[0]).unlink()
    written, problems = write_labels(dataset, format, tmp_path / FILES[format])
    assert written == 2
    assert any(NAMES[0] in problem and "no such picture" in problem for problem in problems)


def test_nothing_to_write_is_refused(tmp_path: Path) -> None:
    dataset = replace(objects(tmp_path, SCHEMES[0]), faces=())
    with pytest.raises(InputError, match="there are none"):
        write_labels(dataset, "tps", tmp_path / "l.tps")
    assert not (tmp_path / "l.tps").exists()


def geomorph(path: Path) -> np.ndarray:
    """(N, L, 2) landmarks as geomorph's documentation says that it reads TPS files: lines without an equals sign are
    coordinates, NA is missing, and all are multiplied by the scale if all specimens have one."""
    lines = path.read_text(encoding="utf-8").splitlines()
    counts = [int(line[3:]) for line in lines if line.startswith("LM=")]
    scales = [float(line[6:]) for line in lines if line.startswith("SCALE=")]
    numbers = [float(word.replace("NA", "nan")) for line in lines if line and "=" not in line for word in line.split()]
    points = np.reshape(numbers, (len(counts), counts[0], 2))
    return points * np.reshape(scales, (-1, 1, 1)) if len(scales) == len(counts) else points


def parts(path: Path) -> np.ndarray:
    """The parts of an XML file of imglab."""
    boxes = ElementTree.parse(path).getroot().findall("./images/image/box")
    return np.array([[[int(part.get(axis, "")) for axis in "xy"] for part in box.findall("part")] for box in boxes])


def keypoints(path: Path) -> np.ndarray:
    """The keypoints of a COCO file."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return np.array([np.reshape(each["keypoints"], (-1, 3))[:, :2] for each in content["annotations"]])


def columns(path: Path) -> np.ndarray:
    """The points of a wide table."""
    with path.open(encoding="utf-8", newline="") as file:
        return np.array([[[float(row[f"{axis}{n}"]) for axis in "xy"] for n in (1, 2)] for row in csv.DictReader(file)])


@pytest.mark.parametrize(
    ("name", "reader", "flipped"),
    [("l.tps", geomorph, True), ("l.xml", parts, False), ("l.json", keypoints, False), ("l.csv", columns, False)],
)
def test_the_command_writes_what_other_programs_read(
    name: str, reader: Callable[[Path], np.ndarray], flipped: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_picture(tmp_path / "a.png")
    given = tmp_path / "given.csv"
    given.write_text("image,x1,y1,x2,y2,scale\na.png,1,2,3,4,0.5\na.png,5,6,7,8,0.5\n")
    assert main(["convert", str(given), str(tmp_path / name)]) == 0
    wanted = np.array([[[1, 2], [3, 4]], [[5, 6], [7, 8]]], float)
    if flipped:  # 30 rows
        wanted = 0.5 * np.stack([wanted[..., 0], 30 - wanted[..., 1]], -1)
    np.testing.assert_array_equal(reader(tmp_path / name), wanted)
    assert "2 of 2 objects with 2 points" in capsys.readouterr().out
    assert not list(tmp_path.glob(".*"))


def test_the_command_never_writes_over_what_it_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_picture(tmp_path / "a.png")
    given = tmp_path / "given.csv"
    given.write_text("image,x1,y1\na.png,1,2\n")
    for out in (given, f"csv:{tmp_path / 'a.png'}"):
        assert main(["convert", str(given), str(out)]) == 2
        assert "would be written over" in capsys.readouterr().err
    assert main(["convert", str(given), str(tmp_path / "nowhere" / "l.tps")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_targets() -> None:
    assert parse_target("l.TPS") == ("tps", Path("l.TPS"))
    assert parse_target("ml-morph:l.csv") == ("ml-morph", Path("l.csv"))
    assert parse_target("pts:folder") == ("pts", Path("folder"))
    for text in ("folder", "tps:", "what:l", "what:l.tps", "l.txt"):
        with pytest.raises(InputError, match="expected FORMAT:PATH"):
            parse_target(text)
