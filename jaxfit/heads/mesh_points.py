"""Landmarks of a mesh: each a vertex, or a weighted mean of some; sets of them in a JSON file."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.inputs import read_text
from jaxfit.errors import DatasetError, InputError

_MOST_BYTES = 1 << 26

# One point: (vertex, weight) pairs, sorted by vertex.
_Point = tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class MeshPoints:
    """Points of a mesh, whatever shape it takes.

    Attributes:
        vertices: (L, K) indices of the vertices that each point is a mean of; as many as the point with most needs.
        weights: (L, K) their weights, which sum to 1; 0 where a point needs fewer.
    """

    vertices: np.ndarray
    weights: np.ndarray

    def at(self, vertices: np.ndarray) -> np.ndarray:
        """The points (..., L, 3) of meshes with ``vertices`` (..., V, 3); likewise of offsets of vertices.

        Raises:
            InputError: the meshes have fewer vertices than the points name.
        """
        vertices = np.asarray(vertices)
        if vertices.ndim < 2 or vertices.shape[-2] <= self.vertices.max():
            raise InputError(
                f"expected meshes (..., V, 3) with more than {self.vertices.max()} vertices, which is the highest that "
                f"the points name; got {vertices.shape}; use the points of this mesh"
            )
        return np.einsum("...lkd,lk->...ld", vertices[..., self.vertices, :], self.weights)

    def __len__(self) -> int:
        return len(self.vertices)


def read_mesh_points(path: str | Path) -> dict[str, MeshPoints]:
    """The sets of points in a JSON file, by name.

    The file is ``{"set": [point, ...], ...}``. A point is the index of a vertex, counted from 0, or
    ``{"vertices": [...], "weights": [...]}``; without weights it is the mean of its vertices.

    Raises:
        DatasetError: the file is missing or not such a file: the message names the point and what is wrong with it.
    """
    try:
        content = json.loads(read_text(path, _MOST_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: expected a JSON file of mesh points; {error}") from error
    if not isinstance(content, dict) or not content:
        raise DatasetError(f"{path}: expected a JSON object with sets of points by name")
    sets = {}
    for name, points in content.items():
        if not isinstance(points, list) or not points:
            raise DatasetError(f"{path}: {name}: expected a list of points")
        sets[name] = _padded([_point(f"{path}: {name}, point {index}", point) for index, point in enumerate(points)])
    return sets


def union(sets: Mapping[str, MeshPoints]) -> tuple[MeshPoints, dict[str, tuple[int, ...]]]:
    """The points of all sets, each once, and for every set the indices of its points among them."""
    found: dict[_Point, int] = {}
    indices = {
        name: tuple(found.setdefault(point, len(found)) for point in _unpadded(points)) for name, points in sets.items()
    }
    return _padded(list(found)), indices


def _point(where: str, value: Any) -> _Point:
    if _is_vertex(value):
        return ((value, 1.0),)
    if not isinstance(value, dict) or not {"vertices"} <= value.keys() <= {"vertices", "weights"}:
        raise DatasetError(
            f'{where}: expected a vertex, counted from 0, or {{"vertices": [...], "weights": [...]}}; got {value!r}'
        )
    vertices = value["vertices"]
    if not isinstance(vertices, list) or not vertices or not all(map(_is_vertex, vertices)):
        raise DatasetError(f"{where}: expected a list of vertices, counted from 0; got {vertices!r}")
    if len(set(vertices)) < len(vertices):
        raise DatasetError(f"{where}: expected every vertex once; got {vertices!r}")
    weights = value.get("weights", [1 / len(vertices)] * len(vertices))
    # A JSON true is Python's 1; comparisons with a NaN are false.
    if (
        not isinstance(weights, list)
        or len(weights) != len(vertices)
        or not all(isinstance(weight, int | float) and not isinstance(weight, bool) for weight in weights)
        or not abs(sum(weights) - 1) < 1e-4
    ):
        raise DatasetError(
            f"{where}: expected a weight for each of {len(vertices)} vertices, together 1; got {weights!r}"
        )
    # Digits that the file rounds away move no point off its vertices.
    total = sum(weights)
    return tuple(sorted((vertex, weight / total) for vertex, weight in zip(vertices, weights, strict=True)))


def _is_vertex(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31


def _padded(points: Sequence[_Point]) -> MeshPoints:
    columns = list(zip_longest(*points, fillvalue=(0, 0.0)))
    vertices = np.array([[vertex for vertex, _ in column] for column in columns]).T
    weights = np.array([[weight for _, weight in column] for column in columns]).T
    return MeshPoints(vertices, weights)


def _unpadded(points: MeshPoints) -> list[_Point]:
    return [
        tuple((int(vertex), float(weight)) for vertex, weight in zip(*row, strict=True) if weight)
        for row in zip(points.vertices, points.weights, strict=True)
    ]
