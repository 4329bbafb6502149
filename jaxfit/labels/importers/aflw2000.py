"""AFLW2000-3D: MATLAB files with 68 points and the pose of a fitted 3D model, one a face, beside the pictures."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxfit.data.inputs import open_regular
from jaxfit.errors import DatasetError, InputError
from jaxfit.labels.importers.matlab import read_matlab
from jaxfit.labels.records import Dataset, FaceRecord, check_pictures
from jaxfit.schemes.known import IBUG68
from jaxfit.shapes.camera import PoseOrder

_MOST_DEGREES = 99.0  # the usual protocol

# Pixels are counted from 1, as MATLAB does. The detected points pt2d of 628 files are whole numbers of pixels before
# the picture was resized if resizing kept the place of a first pixel called 1 (93 % of 20,336 coordinates; 0.4 % if it
# is called 0), and where they are missing they are -1 and 452, mirror images of each other if pixels are called 1 to
# 450. Weaker, for pt3d_68 itself: 533 fits of parametric68, trained on points counted from 0, to nearly frontal faces
# and their mirror images lie 0.6 +- 0.1 pixels to its left (eyes 0.0, nose 0.8, mouth 0.7), where 1 is expected, or 0
# if it counted from 0. Published Python code takes the coordinates as they are.
_FIRST_PIXEL = 1

# The signs are ours, verified against the landmarks of the 618 faces with angles up to 99 degrees: roll rises with the
# clockwise slope of the line through the eye centres (correlation 0.94, yaws under 45 degrees); yaw falls as the nose
# moves to the right of the outline's upper ends (-0.99); pitch rises as the nose comes nearer to the eyes (0.82) and as
# the outline's upper ends, at the ears, sink below them (0.84, both for yaws under 15).
#
# The order is not Eq. 15's: the head is rolled, then turned (yaw), then pitched, R = R_pitch R_yaw R_roll. Rotations of
# the mean of the 10 most frontal faces to each face's pt3d_68 (Kabsch) have angles whose median distance from
# Pose_Para, roll, pitch, yaw in degrees, is 0.7, 1.5, 0.4 in this order and 2.6, 1.8, 0.6 in Eq. 15's; for the 87 faces
# with yaws from 60 degrees it is 4.9, 4.5, 0.6 and 19.5, 13.5, 1.8. The mean ICT-FaceKit head instead agrees.
_ORDER: PoseOrder = "roll-yaw-pitch"


def read_aflw2000(folder: str | Path, most_degrees: float = _MOST_DEGREES) -> Dataset:
    """Every ``.mat`` directly in ``folder``, sorted by name; its picture is the ``.jpg`` of the same stem.

    Landmarks are x and y of ``pt3d_68``, which has hidden points where they would be seen through the head; all count
    as visible, as the files do not say. The pose is ``Pose_Para`` in degrees, some of it beyond a full turn, and in the
    order of the dataset. Files that cannot be used become problems.

    Args:
        folder: where the files are.
        most_degrees: faces with an angle beyond ± this are left out, and counted in a problem; infinity keeps all.

    Raises:
        DatasetError: no such folder, nothing in it can be used, or no file has a picture.
        InputError: ``most_degrees`` is not positive.
    """
    if not most_degrees > 0:
        raise InputError(f"most_degrees must be positive, infinity to keep all faces; got {most_degrees}")
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: expected a folder of AFLW2000's .mat files with their pictures, found none")
    read, problems = [], []
    for path in sorted(path for path in folder.iterdir() if path.suffix.lower() == ".mat" and path.is_file()):
        try:
            read.append(_read(path))
        except DatasetError as error:
            problems.append(str(error))
    faces = [face for face in read if face.pose is not None and np.abs(face.pose).max() <= most_degrees]
    if left_out := len(read) - len(faces):
        problems.append(
            f"{left_out} of {len(read)} faces left out: an angle over {most_degrees:g} degrees "
            "(aflw2000-all keeps them)"
        )
    if not faces:
        reason = f"; first problem: {problems[0]}" if problems else ""
        raise DatasetError(f"{folder}: expected AFLW2000's .mat files, found none that can be used{reason}")
    check_pictures(folder, faces)
    name = "aflw2000" if np.isfinite(most_degrees) else "aflw2000-all"
    return Dataset(f"{name}:{folder}", IBUG68, tuple(faces), tuple(problems))


_MOST_BYTES = 1 << 24  # of an array of landmarks
_OWN, _AGAIN = "AFLW2000-3D.pts68.npy", "AFLW2000-3D-Reannotated.pts68.npy"


def read_aflw2000_again(folder: str | Path) -> Dataset:
    """AFLW2000-3D with the landmarks of those who annotated its pictures again (Bulat and Tzimiropoulos, 2017), as
    3DDFA's authors publish them: ``AFLW2000-3D-Reannotated.pts68.npy``, (F, 2, 68), which lies in the folder with
    ``AFLW2000-3D.pts68.npy``, (F, 3, 68), whose rows are those of the ``.mat`` files and say which face is which.

    Poses are those of the ``.mat`` files, all of them. The coordinates are taken as they are: on nearly frontal faces
    they lie half a pixel from those of the ``.mat`` files counted from 0, and one and a half from those counted from 1.

    Raises:
        DatasetError: as `read_aflw2000`, or one of the two files is missing or has another shape.
    """
    folder = Path(folder)
    found = read_aflw2000(folder, math.inf)
    own, again = (_points(folder / name, sides) for name, sides in ((_OWN, 3), (_AGAIN, 2)))
    if len(own) != len(again):
        raise DatasetError(f"{folder}: expected as many faces in {_OWN} and {_AGAIN}; got {len(own)} and {len(again)}")
    rows = {points[:2].tobytes(): row for row, points in enumerate(own)}
    faces, problems = [], list(found.problems)
    for face in found.faces:
        row = rows.get(np.float32(face.landmarks + _FIRST_PIXEL).T.tobytes())
        if row is None:
            problems.append(f"{face.image}: its landmarks are not among those of {_OWN}")
        else:
            faces.append(replace(face, landmarks=again[row].T.astype(np.float64)))
    if not faces:
        raise DatasetError(f"{folder}: expected the faces of {_OWN}, found none; first problem: {problems[0]}")
    return Dataset(f"aflw2000-re:{folder}", IBUG68, tuple(faces), tuple(problems))


def _points(file: Path, sides: int) -> np.ndarray:
    """The points (F, sides, 68), float32, of one of the two files."""
    try:
        with open_regular(file, _MOST_BYTES) as stream:
            points = np.load(stream, allow_pickle=False)
    except (OSError, ValueError, EOFError, MemoryError, OverflowError) as error:
        raise DatasetError(f"{file}: expected the landmarks of AFLW2000-3D as an array; {error}") from None
    if points.ndim != 3 or points.shape[1:] != (sides, IBUG68.count) or not np.isfinite(points).all():
        raise DatasetError(f"{file}: expected finite numbers (faces, {sides}, {IBUG68.count}); got {points.shape}")
    return np.ascontiguousarray(points, np.float32)


def _read(path: Path) -> FaceRecord:
    points, angles = _arrays(path, {"pt3d_68": (3, IBUG68.count), "Pose_Para": (1, 7)})
    present = np.ones(IBUG68.count, bool)
    pitch, yaw, roll = np.degrees(angles[0, :3])
    return FaceRecord(
        image=path.with_suffix(".jpg"),
        landmarks=points[:2].T - _FIRST_PIXEL,
        present=present,
        visible=present.copy(),
        box=None,
        pose=np.array([roll, pitch, yaw]),
        subject=path.stem,
        face=path.stem,
        pose_order=_ORDER,
    )


def _arrays(path: Path, shapes: dict[str, tuple[int, int]]) -> list[np.ndarray]:
    """The named variables of a MATLAB file as float64.

    Raises:
        DatasetError: the file cannot be read, lacks one, or has one of another shape or of other than finite numbers.
    """
    variables = read_matlab(path)
    for name, shape in shapes.items():
        array = variables.get(name)
        found = "none" if array is None else f"{array.dtype} {array.shape}"
        if array is None or array.shape != shape or not np.isfinite(array).all():
            raise DatasetError(f"{path}: expected finite numbers {name} {shape}, found {found}")
    return [variables[name].astype(np.float64) for name in shapes]
