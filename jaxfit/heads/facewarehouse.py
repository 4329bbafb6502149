"""FaceWarehouse: 150 people's heads as meshes of one topology, 20 poses or 47 blendshapes of each."""

import re
from pathlib import Path
from typing import Literal

import numpy as np

from jaxfit.data.inputs import read_regular, read_text
from jaxfit.data.numbers import number
from jaxfit.errors import DatasetError, InputError
from jaxfit.heads.mesh_points import MeshPoints

# Assumed, as in ICT-FaceKit: x to the subject's left, which is the picture's right, y up and z to the viewer.
_AXES = np.array([1.0, -1.0, -1.0])
_MOST_BYTES = 1 << 28  # of a mesh, or of all meshes of a person
_POSES = 20


def read_facewarehouse(
    folder: str | Path, points: MeshPoints, faces: Literal["poses", "blendshapes"] = "poses"
) -> tuple[np.ndarray, list[str]]:
    """Landmarks (N, L, 3) of FaceWarehouse's heads, and what could not be read, one sentence each.

    The testers ``Tester_1``, ``Tester_2``, … in ``folder`` come in the order of their numbers. Of each are read the 20
    meshes ``TrainingPose/pose_<0..19>.obj``, or the 47 in ``Blendshape/shape.bs``; both begin with the neutral one.
    Axes become x right, y down, z away from the viewer; the files' are assumed to be y up and z to the viewer. Lengths
    stay in the files' unit.

    Raises:
        DatasetError: there are no testers, or nothing of them can be used.
        InputError: ``faces`` is neither "poses" nor "blendshapes".
    """
    if faces not in ("poses", "blendshapes"):
        raise InputError(f"expected faces 'poses' or 'blendshapes', got {faces!r}")
    found, problems = [], []
    for tester in _testers(Path(folder)):
        if faces == "poses":
            files = [tester / "TrainingPose" / f"pose_{pose}.obj" for pose in range(_POSES)]
        else:
            files = [tester / "Blendshape" / "shape.bs"]
        for file in files:
            try:
                meshes = _read_obj(file) if faces == "poses" else _read_shapes(file)
                found.append(points.at(meshes))
            except DatasetError as error:
                problems.append(str(error))
            except InputError as error:
                problems.append(f"{file}: {error}")
    if not found:
        raise DatasetError(f"{folder}: no tester's heads can be used; first problem: {problems[0]}")
    return np.concatenate(found) * _AXES, problems


def _testers(folder: Path) -> list[Path]:
    try:
        names = [path.name for path in folder.iterdir()]
    except OSError as error:
        raise DatasetError(f"{folder}: expected FaceWarehouse's folder; {error}") from error
    numbers = sorted(int(match[1]) for name in names if (match := re.fullmatch(r"Tester_([1-9][0-9]{0,5})", name)))
    if not numbers:
        raise DatasetError(f"{folder}: expected FaceWarehouse's folders Tester_1, Tester_2, …; found none")
    return [folder / f"Tester_{number}" for number in numbers]


def _read_obj(file: Path) -> np.ndarray:
    """The vertices (1, V, 3) of a Wavefront file."""
    try:
        lines = read_text(file, _MOST_BYTES).splitlines()
        vertices = np.array([[number(word) for word in line.split()[1:4]] for line in lines if line[:2] == "v "])
    except (OSError, ValueError) as error:
        raise DatasetError(f"{file}: expected a mesh of lines 'v x y z'; {error}") from error
    return _checked(file, vertices[None])


def _read_shapes(file: Path) -> np.ndarray:
    """The vertices (S, V, 3) of a ``shape.bs``: the counts of meshes but one, vertices and faces; then all vertices."""
    try:
        data = read_regular(file, _MOST_BYTES)
    except OSError as error:
        raise DatasetError(f"{file}: expected FaceWarehouse's blendshapes; {error}") from error
    if len(data) < 12:
        raise DatasetError(f"{file}: expected three counts of four bytes each, got {len(data)} bytes; copy it again")
    further, vertices, _ = (int(count) for count in np.frombuffer(data, "<i4", 3))
    if further < 0 or vertices < 1 or len(data) != 12 + 12 * (further + 1) * vertices:
        raise DatasetError(
            f"{file}: its counts are {further} + 1 meshes of {vertices} vertices, which its {len(data)} bytes do not "
            "hold; copy it again"
        )
    return _checked(file, np.frombuffer(data, "<f4", offset=12).reshape(further + 1, vertices, 3))


def _checked(file: Path, meshes: np.ndarray) -> np.ndarray:
    if meshes.ndim != 3 or meshes.shape[2] != 3 or not np.isfinite(meshes).all():
        raise DatasetError(f"{file}: expected vertices of three finite coordinates; copy it again")
    return meshes
