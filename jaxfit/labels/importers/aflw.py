"""AFLW: an SQLite database of up to 21 points a face, the rough head pose, and several faces a picture."""

import re
import sqlite3
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

from jaxfit.errors import DatasetError
from jaxfit.labels.records import Dataset, FaceRecord, check_pictures
from jaxfit.schemes.known import AFLW21

# From AFLW's (roll, pitch, yaw) to ours. Verified against the landmarks of 3,403 faces, and by looking at the pictures
# with the largest angles. AFLW's roll falls with the clockwise slope of the line through the eye centres (correlation
# -0.97): its sign turns. Its yaw falls with the nose's position along that line (-0.86), and positive yaw hides the
# ear on the image's left; its pitch rises as the nose comes nearer to the eyes (0.67) and as the ears sink below them
# (0.82, both for yaws under 15 degrees): these signs stay.
_SIGNS = np.array([-1.0, 1.0, 1.0])

_FACES = """
    SELECT Faces.face_id, CAST(filepath AS TEXT), x, y, w, h, roll, pitch, yaw
    FROM Faces
    LEFT JOIN FaceImages ON FaceImages.file_id = Faces.file_id
    LEFT JOIN FaceRect ON FaceRect.face_id = Faces.face_id
    LEFT JOIN FacePose ON FacePose.face_id = Faces.face_id
    GROUP BY Faces.face_id
    ORDER BY Faces.face_id
"""
_TABLES = ("Faces", "FaceImages", "FaceRect", "FacePose", "FeatureCoords")
_COMPUTED = re.compile(r"\bvirtual\b|\bgenerated\b|\bas\s*\(", re.IGNORECASE)  # tables and columns
# AFLW has 26,000 faces and 380,000 points, which are read in two seconds.
_MOST_SECONDS, _MOST_ROWS, _MOST_LETTERS, _MOST_BYTES = 30.0, 5_000_000, 4096, 100_000
_POINTS = "SELECT face_id, feature_id, x, y FROM FeatureCoords"


def read_aflw(folder: str | Path) -> Dataset:
    """The faces of AFLW: ``aflw.sqlite`` in ``folder`` or ``folder/data``, the pictures in ``flickr`` beside it.

    Landmarks are the picture's pixels, taken as 0-based; a point without a row is not present. The box is ``FaceRect``,
    the pose ``FacePose`` in degrees and in our signs. Faces of one picture share a subject. Faces of no named
    picture or without any landmark become problems.

    Raises:
        DatasetError: the database is missing, damaged or lacks a table, no face can be used, or no picture exists.
    """
    file = _database(Path(folder))
    with _opened(file) as database:
        rows = list(_limited(database.execute(_FACES)))
        points = _points(database)
    faces, problems = [], []
    for face, picture, *numbers in rows:
        try:
            faces.append(_record(file.parent / "flickr", face, picture, numbers, points.get(face)))
        except DatasetError as error:
            problems.append(str(error))
    if not faces:
        reason = f"first problem: {problems[0]}" if problems else "it lists no faces"
        raise DatasetError(f"{file}: expected faces with landmarks; {reason}")
    check_pictures(file, faces)
    return Dataset(spec=f"aflw:{folder}", scheme=AFLW21, faces=tuple(faces), problems=tuple(problems))


def _database(folder: Path) -> Path:
    for file in (folder / "aflw.sqlite", folder / "data" / "aflw.sqlite"):
        if file.is_file():
            return file
    raise DatasetError(f"{folder}: expected aflw.sqlite here or in data/, found neither; name AFLW's own folder")


@contextmanager
def _opened(file: Path) -> Iterator[sqlite3.Connection]:
    # Immutable: SQLite then makes no lock or journal files, which read-only media would refuse.
    stop = _Stop()
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            database.set_progress_handler(stop, 10_000)
            _restrain(database)
            yield database
    except sqlite3.OperationalError as error:
        if stop.interrupted:
            raise KeyboardInterrupt from None
        why = f"reading it takes over {_MOST_SECONDS:g} seconds" if stop.late else error
        raise DatasetError(f"{file}: expected AFLW's SQLite database; {why}; copy it again") from error
    except (sqlite3.Error, UnicodeError) as error:  # SQLite's own messages may quote bytes that are no text
        raise DatasetError(f"{file}: expected AFLW's SQLite database; {error}; copy it again") from error


class _Stop:
    """Whether SQLite has to stop, which asks again and again, and forgets errors.

    Attributes:
        late: because it has taken too long.
        interrupted: because of Ctrl-C.
    """

    def __init__(self) -> None:
        self._end = time.monotonic() + _MOST_SECONDS
        self.late = self.interrupted = False

    def __call__(self) -> bool:
        try:
            self.late = time.monotonic() > self._end
        except KeyboardInterrupt:
            self.interrupted = True
        return self.late or self.interrupted


def _restrain(database: sqlite3.Connection) -> None:
    """Let nothing in the file run: it may be of anyone.

    Raises:
        sqlite3.Error: something that is read is no table, but computed.
    """
    database.execute("PRAGMA trusted_schema = OFF")
    database.execute("PRAGMA cell_size_check = ON")
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_BYTES)
    kinds = dict(database.execute("SELECT lower(name), type || ' ' || sql FROM sqlite_master WHERE type <> 'index'"))
    for table in _TABLES:
        kind = str(kinds.get(table.lower(), ""))
        if kind and (not kind.startswith("table") or _COMPUTED.search(kind)):
            raise sqlite3.DataError(f"{table} is no plain table of stored values")


def _limited(rows: Iterable[tuple]) -> Iterator[tuple]:
    """Rows, if they are as many and as long as those of a dataset."""
    for number, row in enumerate(rows):
        if number >= _MOST_ROWS or any(isinstance(cell, str | bytes) and len(cell) > _MOST_LETTERS for cell in row):
            raise sqlite3.DataError(f"over {_MOST_ROWS:,} rows, or a text of over {_MOST_LETTERS:,} letters")
        yield row


def _points(database: sqlite3.Connection) -> dict[int, np.ndarray]:
    """Face number to landmarks (21, 2), NaN where there is no row."""
    points: dict[int, np.ndarray] = {}
    rows = list(_limited(database.execute(_POINTS)))
    places = _numbers([cell for row in rows for cell in row[2:]]).reshape(-1, 2)
    for (face, feature, *_), place in zip(rows, places, strict=True):
        if not isinstance(feature, int) or not 1 <= feature <= AFLW21.count:
            raise sqlite3.DataError(f"feature_id {feature!r} of face {face} is not one of 1 to {AFLW21.count}")
        if face not in points:
            points[face] = np.full((AFLW21.count, 2), np.nan)
        points[face][feature - 1] = place
    return points


def _record(flickr: Path, face: int, picture: str | None, numbers: list, landmarks: np.ndarray | None) -> FaceRecord:
    if not picture:
        raise DatasetError(f"AFLW face {face}: the database names no picture for it")
    if ".." in Path(picture).parts or Path(picture).is_absolute():
        raise DatasetError(f"AFLW face {face}: the database names {picture!r}, which is not in {flickr.name}")
    if landmarks is None or not np.isfinite(landmarks).all(1).any():
        raise DatasetError(f"AFLW face {face} in {picture}: no landmarks")
    present = np.isfinite(landmarks).all(1)
    box, pose = _numbers(numbers[:4]), np.degrees(_SIGNS * _numbers(numbers[4:]))
    return FaceRecord(
        image=flickr / picture,
        landmarks=np.where(present[:, None], landmarks, np.nan),
        present=present,
        visible=present.copy(),
        box=box if np.isfinite(box).all() else None,
        pose=pose if np.isfinite(pose).all() else None,
        subject=picture,
        face=str(face),
    )


def _numbers(cells: list) -> np.ndarray:
    """SQL values as float64; SQLite columns may hold anything, and what is not a number is NaN."""
    return np.array([cell if isinstance(cell, int | float) else np.nan for cell in cells], np.float64)
