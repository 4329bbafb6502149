"""Writes small files of labels in each format, with known faces, for the tests of their readers."""

import json
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from jaxfit.data.pictures import write_image
from jaxfit.data.pts import write_pts
from jaxfit.schemes.known import LFPW29_NAMES

# Pictures that are only looked for.
_NOT_LOOKED_AT = b"not looked at"


# iBUG


def write_pts_face(folder: Path, stem: str, count: int = 3, picture: str = ".jpg") -> None:
    """``picture`` is the suffix of the picture, if there is one."""
    write_pts(folder / f"{stem}.pts", np.arange(2.0 * count).reshape(count, 2))
    if picture:
        (folder / f"{stem}{picture}").write_bytes(_NOT_LOOKED_AT)


# AFLW

AFLW_POINTS = np.arange(42.0).reshape(21, 2) + 0.5
_TABLES = """
    CREATE TABLE Faces(face_id INTEGER PRIMARY KEY, file_id TEXT, db_id TEXT);
    CREATE TABLE FaceImages(image_id INTEGER PRIMARY KEY, db_id TEXT, file_id TEXT, filepath TEXT);
    CREATE TABLE FacePose(face_id INTEGER PRIMARY KEY, roll REAL, pitch REAL, yaw REAL);
    CREATE TABLE FaceRect(face_id INTEGER PRIMARY KEY, x INTEGER, y INTEGER, w INTEGER, h INTEGER);
    CREATE TABLE FeatureCoords(face_id INTEGER, feature_id INTEGER, x REAL, y REAL,
                               PRIMARY KEY(face_id, feature_id));
"""


def new_aflw(folder: Path) -> sqlite3.Connection:
    """AFLW's database without faces."""
    (folder / "flickr" / "0").mkdir(parents=True)
    database = sqlite3.connect(folder / "aflw.sqlite", isolation_level=None)
    database.execute("PRAGMA synchronous = OFF")
    database.executescript(_TABLES)
    return database


def add_aflw_face(
    database: sqlite3.Connection, face: int, picture: str = "p1", features: Iterable[int] = range(1, 22)
) -> None:
    database.execute("INSERT INTO Faces VALUES (?, ?, 'aflw')", (face, picture))
    database.execute("INSERT INTO FacePose VALUES (?, 0.1, 0.2, 0.3)", (face,))
    database.execute("INSERT INTO FaceRect VALUES (?, -1, 2, 30, 40)", (face,))
    for feature in features:
        x, y = AFLW_POINTS[feature - 1]
        database.execute("INSERT INTO FeatureCoords VALUES (?, ?, ?, ?)", (face, feature, x, y))


def add_aflw_picture(database: sqlite3.Connection, folder: Path, picture: str, on_disk: bool = True) -> None:
    database.execute(
        "INSERT INTO FaceImages(db_id, file_id, filepath) VALUES ('aflw', ?, ?)", (picture, f"0/{picture}")
    )
    if on_disk:
        (folder / "flickr" / "0" / picture).touch()


# LFPW

LFPW_POINTS = np.arange(58.0).reshape(29, 2) + 0.25


def lfpw_row(
    image: str = "a.jpg", worker: str = "average", states: Sequence[int] = (0,) * 29, **changes: str
) -> dict[str, str]:
    cells = {"imgurl": image, "worker": worker, "left_ear_top_x": "5"}
    for name, (x, y), state in zip(LFPW29_NAMES, LFPW_POINTS, states, strict=True):
        cells |= {f"{name}_x": f"{x}", f"{name}_y": f"{y}", f"{name}_t": f"{state}"}
    return cells | changes


def write_lfpw(folder: Path, rows: list[dict[str, str]], columns: list[str] | None = None) -> Path:
    columns = columns or list(rows[0])
    lines = ["\t".join(columns)] + ["\t".join(cells[column] for column in columns) for cells in rows]
    (folder / "lfpw.csv").write_text("\n".join(lines) + "\n")
    return folder / "lfpw.csv"


# Pointing'04

POINTING04_BOX = "192\n237\n126\n95\n"


def write_pointing04_face(folder: Path, stem: str, box: str | None = POINTING04_BOX, picture: bool = True) -> None:
    folder.mkdir(exist_ok=True)
    if picture:
        (folder / f"{stem}.jpg").touch()
    if box is not None:
        (folder / f"{stem}.txt").write_text(f"{stem}.jpg\n\nFace\n{box}")


# AFLW2000-3D

AFLW2000_POINTS = np.arange(3 * 68.0).reshape(3, 68) + 0.5


def write_aflw2000_face(
    folder: Path, stem: str = "image1", picture: bool = True, pose: Sequence[float] = (0.1, 0.2, 0.3), **changed: Any
) -> None:
    variables = {
        "Pose_Para": np.array([[*pose, 300, 200, -20, 1e-3]], np.float32),
        "pt3d_68": AFLW2000_POINTS.astype(np.float32),
        "pt2d": -np.ones((2, 21)),
    }
    variables |= changed
    present = {name: value for name, value in variables.items() if value is not None}
    savemat(folder / f"{stem}.mat", present, do_compression=True)
    if picture:
        (folder / f"{stem}.jpg").touch()


# Of every format: faces by name, in the order in which they are read, and whether they have their pictures. What
# writes them returns the path to read and the faces' names.

Written = tuple[Path, list[str]]


def _pts(folder: Path, pictures: Sequence[bool]) -> Written:
    names = [f"face{number}a" for number in range(len(pictures))]
    for name, there in zip(names, pictures, strict=True):
        write_pts_face(folder, name, picture=".jpg" if there else "")
    return folder, names


def _aflw(folder: Path, pictures: Sequence[bool]) -> Written:
    with closing(new_aflw(folder)) as database:
        for number, there in enumerate(pictures):
            add_aflw_picture(database, folder, f"p{number}", there)
            add_aflw_face(database, number, f"p{number}")
    return folder, [str(number) for number in range(len(pictures))]


def _lfpw(folder: Path, pictures: Sequence[bool]) -> Written:
    names = [f"p{number}" for number in range(len(pictures))]
    for name, there in zip(names, pictures, strict=True):
        if there:
            (folder / f"{name}.jpg").touch()
    return write_lfpw(folder, [lfpw_row(f"{name}.jpg") for name in names]), names


def _pointing04(folder: Path, pictures: Sequence[bool]) -> Written:
    names = [f"person0110{number}-90+0" for number in range(len(pictures))]
    for name, there in zip(names, pictures, strict=True):
        write_pointing04_face(folder / "Person01", name, picture=there)
    return folder, names


def _aflw2000(folder: Path, pictures: Sequence[bool]) -> Written:
    names = [f"image{number}" for number in range(len(pictures))]
    for name, there in zip(names, pictures, strict=True):
        write_aflw2000_face(folder, name, picture=there)
    return folder, names


def _aflw2000_again(folder: Path, pictures: Sequence[bool]) -> Written:
    points = AFLW2000_POINTS.astype(np.float32)
    np.save(folder / "AFLW2000-3D.pts68.npy", points[None])
    np.save(folder / "AFLW2000-3D-Reannotated.pts68.npy", points[None, :2])
    return _aflw2000(folder, pictures)


# Files of annotations


def write_picture(path: Path, width: int = 40, height: int = 30) -> None:
    """A grey picture: readers that count from the bottom need its height."""
    write_image(path, np.full((height, width, 3), 90, np.uint8))


def _pictures(folder: Path, pictures: Sequence[bool]) -> list[str]:
    names = [f"p{number}" for number in range(len(pictures))]
    for name, there in zip(names, pictures, strict=True):
        if there:
            write_picture(folder / f"{name}.png")
    return names


def _tps(folder: Path, pictures: Sequence[bool]) -> Written:
    names = _pictures(folder, pictures)
    (folder / "a.tps").write_text("".join(f"LM=2\n1 2\n3. 4\nIMAGE={name}.png\n\n" for name in names))
    return folder / "a.tps", names


def _imglab(folder: Path, pictures: Sequence[bool]) -> Written:
    names = _pictures(folder, pictures)
    parts = "<part name='0' x='1' y='2'/><part name='1' x='3' y='4'/>"
    images = "".join(
        f"<image file='{name}.png'><box top='0' left='1' width='9' height='8'>{parts}</box></image>" for name in names
    )
    (folder / "a.xml").write_text(f"<?xml version='1.0'?><dataset><images>{images}</images></dataset>")
    return folder / "a.xml", names


def _coco(folder: Path, pictures: Sequence[bool]) -> Written:
    names = _pictures(folder, pictures)
    images = [{"id": number, "file_name": f"{name}.png"} for number, name in enumerate(names)]
    annotations = [
        {"id": n, "image_id": n, "category_id": 1, "keypoints": [1, 2, 2, 3, 4, 2], "bbox": [0, 0, 9, 9]}
        for n in range(len(names))
    ]
    categories = [{"id": 1, "name": "wing", "keypoints": ["tip", "root"]}]
    content = {"images": images, "annotations": annotations, "categories": categories}
    (folder / "a.json").write_text(json.dumps(content))
    return folder / "a.json", names


def _csv(folder: Path, pictures: Sequence[bool]) -> Written:
    names = _pictures(folder, pictures)
    (folder / "a.csv").write_text("image,x1,y1,x2,y2\n" + "".join(f"{name}.png,1,2,3,4\n" for name in names))
    return folder / "a.csv", names


def _ml_morph(folder: Path, pictures: Sequence[bool]) -> Written:
    names = _pictures(folder, pictures)
    (folder / "a.csv").write_text("id,X0,Y0,X1,Y1\n" + "".join(f"{name}.png,1,2,3,4\n" for name in names))
    return folder / "a.csv", names


WRITE_FACES: Mapping[str, Callable[[Path, Sequence[bool]], Written]] = {
    "pts": _pts,
    "pts0": _pts,
    "aflw": _aflw,
    "lfpw": _lfpw,
    "pointing04": _pointing04,
    "aflw2000": _aflw2000,
    "aflw2000-all": _aflw2000,
    "aflw2000-re": _aflw2000_again,
    "tps": _tps,
    "imglab": _imglab,
    "coco": _coco,
    "csv": _csv,
    "ml-morph": _ml_morph,
}
