"""Points of meshes: means of vertices by hand, files by hand, and what is wrong with files in words."""

import json

import numpy as np
import pytest

from jaxfit.errors import DatasetError, InputError
from jaxfit.heads.mesh_points import MeshPoints, read_mesh_points, union

RNG = np.random.default_rng(0)
MESHES = RNG.normal(size=(2, 5, 7, 3))  # five faces of each of two people, seven vertices


def read(folder, content):
    path = folder / "points.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_mesh_points(path)


def test_a_vertex_a_mean_and_a_barycentric_point(tmp_path):
    points = read(tmp_path, {"some": [4, {"vertices": [1, 6]}, {"vertices": [2, 0, 3], "weights": [0.5, 0.2, 0.3]}]})
    found = points["some"].at(MESHES)
    assert found.shape == (2, 5, 3, 3)
    np.testing.assert_array_equal(found[..., 0, :], MESHES[..., 4, :])
    np.testing.assert_allclose(found[..., 1, :], (MESHES[..., 1, :] + MESHES[..., 6, :]) / 2)
    by_hand = 0.2 * MESHES[..., 0, :] + 0.5 * MESHES[..., 2, :] + 0.3 * MESHES[..., 3, :]
    np.testing.assert_allclose(found[..., 2, :], by_hand)


def test_points_move_with_the_mesh(tmp_path):
    points = read(tmp_path, {"some": [0, {"vertices": [1, 2, 5]}]})["some"]
    turn = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    np.testing.assert_allclose(points.at(MESHES @ turn + 2.0), points.at(MESHES) @ turn + 2.0, atol=1e-12)


def test_rounded_weights_are_made_to_sum_to_one(tmp_path):
    third = {"vertices": [0, 1, 2], "weights": [0.33333, 0.33333, 0.33333]}
    np.testing.assert_allclose(read(tmp_path, {"some": [third]})["some"].weights.sum(1), 1, rtol=1e-12)


def test_the_union_holds_every_point_once_and_each_set_finds_its_own(tmp_path):
    mean = {"vertices": [1, 2, 3]}
    sets = read(
        tmp_path, {"a": [5, mean, 0], "b": [{"vertices": [3, 2, 1]}, 4, {"vertices": [5]}, {"vertices": [1, 2]}]}
    )
    points, indices = union(sets)
    assert len(points) == 5  # 5, the mean of 1, 2, 3, 0, 4, and the mean of 1 and 2
    for name, own in sets.items():
        np.testing.assert_array_equal(points.at(MESHES)[..., list(indices[name]), :], own.at(MESHES))


def test_too_small_a_mesh_is_refused():
    points = MeshPoints(np.array([[0], [7]]), np.ones((2, 1)))
    with pytest.raises(InputError, match="more than 7 vertices"):
        points.at(MESHES)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[", "expected a JSON file"),
        ("[" * 100_000, "expected a JSON file"),
        ([1, 2], "sets of points by name"),
        ({}, "sets of points by name"),
        ({"a": []}, "a: expected a list of points"),
        ({"a": 3}, "a: expected a list of points"),
        ({"a": [0, -1]}, "a, point 1: expected a vertex, counted from 0"),
        ({"a": [1.5]}, "point 0: expected a vertex"),
        ({"a": [True]}, "point 0: expected a vertex"),
        ({"a": [2**40]}, "point 0: expected a vertex"),
        ({"a": [None]}, "point 0: expected a vertex"),
        ({"a": [{"weights": [1]}]}, "point 0: expected a vertex"),
        ({"a": [{"vertices": [1], "weight": [1]}]}, "point 0: expected a vertex"),
        ({"a": [{"vertices": []}]}, "expected a list of vertices"),
        ({"a": [{"vertices": [1, -2]}]}, "expected a list of vertices"),
        ({"a": [{"vertices": [1, 1]}]}, "every vertex once"),
        ({"a": [{"vertices": [1, 2], "weights": [1]}]}, "a weight for each of 2 vertices"),
        ({"a": [{"vertices": [1, 2], "weights": [0.5, 0.4]}]}, "together 1"),
        ({"a": [{"vertices": [1, 2], "weights": [0.5, "x"]}]}, "together 1"),
        ('{"a": [{"vertices": [1, 2], "weights": [NaN, 1]}]}', "together 1"),
        ('{"a": [{"vertices": [1, 2], "weights": [Infinity, -Infinity]}]}', "together 1"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, content, said):
    with pytest.raises(DatasetError, match=said):
        read(tmp_path, content)


def test_a_missing_file(tmp_path):
    with pytest.raises(DatasetError, match="No such file"):
        read_mesh_points(tmp_path / "none.json")
