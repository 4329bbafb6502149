"""Comparing contestants: fits of other programs against a computation by hand, whatever their order and form."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from jaxfit.errors import DatasetError, InputError, JaxfitError
from jaxfit.evaluation.compare import Comparison, plan_comparison, read_contestants
from jaxfit.evaluation.datasets import EvaluationRun
from jaxfit.evaluation.fit_files import read_fits
from jaxfit.schemes.conversions import sources
from jaxfit.schemes.known import AFLW21, IBUG68, MEDIAPIPE478
from jaxfit.shapes.pose_order import in_order

# Where faces lie in each picture, the upper left corner of their landmarks: several in one, and one alone.
PLACES = {
    "a.png": [(10, 10), (200, 10), (10, 200)],
    "b.png": [(40, 40)],
    "c.png": [(0, 0), (150, 0)],
    "d.png": [(5, 5)],
}
# How far off the fit of each face is; None: there is none.
OFF: dict[tuple[str, int], tuple[int, int] | None] = {
    ("a.png", 0): (3, 4),
    ("a.png", 1): (0, 1),
    ("a.png", 2): None,
    ("b.png", 0): (-6, 8),
    ("c.png", 0): (0, 0),
}
OFF |= {("c.png", 1): (5, 0), ("d.png", 0): None}
POSES = {face: (5.0 * n, -10.0 + n, 20.0 - 8 * n) for n, face in enumerate(OFF)}


def shape_of_face(count: int = 68) -> np.ndarray:
    """Points (L, 2) of a face some 100 pixels large; the outer corners of the 68's eyes are 50 pixels apart."""
    points = np.random.default_rng(0).uniform(0, 100, (count, 2))
    points[:2] = [0, 0], [100, 100]
    if count == IBUG68.count:
        points[[36, 45]] = [25, 40], [75, 40]
    return points


@pytest.fixture
def labels(tmp_path: Path) -> str:
    """The spec of the labels, in a table, with poses."""
    lines = [",".join(["image", "subject", *_columns(68), "roll", "pitch", "yaw"])]
    for name, places in PLACES.items():
        cv2.imwrite(str(tmp_path / name), np.zeros((9, 9), np.uint8))
        for number, place in enumerate(places):
            points = shape_of_face() + place
            numbers = [*points.ravel(), *POSES[name, number]]
            lines.append(",".join([name, name, *map(str, numbers)]))
    (tmp_path / "labels.csv").write_text("\n".join(lines))
    return f"csv:{tmp_path / 'labels.csv'}"


def _columns(count: int) -> list[str]:
    return [f"{axis}{number}" for number in range(1, count + 1) for axis in "xy"]


def fitted(shape: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """What another program found, in an order of its own: with a face that nobody labelled, and one in another
    picture."""
    found = [(name, shape + PLACES[name][number] + off) for (name, number), off in OFF.items() if off is not None]
    found += [("b.png", shape + (400, 400)), ("elsewhere.png", shape)]
    return [found[row] for row in np.random.default_rng(3).permutation(len(found))]


def by_hand() -> list[float]:
    """The errors of all faces in the order of the labels: how far they are off, in distances of the eyes."""
    return [math.inf if off is None else math.hypot(*off) / 50 for off in OFF.values()]


def write_csv_fits(folder: Path, shape: np.ndarray) -> str:
    rows = [",".join([name, *map(str, points.ravel())]) for name, points in fitted(shape)]
    (folder / "found.csv").write_text("\n".join([",".join(["image", *_columns(len(shape))]), *rows]))
    return str(folder / "found.csv")


def write_json_lines_fits(folder: Path, shape: np.ndarray) -> str:
    rows = [json.dumps({"image": name, "landmarks": points.tolist()}) for name, points in fitted(shape)]
    (folder / "found.jsonl").write_text("\n".join(rows) + "\n\n")
    return str(folder / "found.jsonl")


def write_coco_fits(folder: Path, shape: np.ndarray) -> str:
    names = sorted({name for name, _ in fitted(shape)})
    content = {
        "images": [{"id": number, "file_name": name} for number, name in enumerate(names)],
        "annotations": [
            {"id": n, "image_id": names.index(name), "category_id": 1, "keypoints": [v for p in at for v in (*p, 2)]}
            for n, (name, at) in enumerate(fitted(shape))
        ],
        "categories": [{"id": 1, "name": "face", "keypoints": [f"p_{n + 1}" for n in range(len(shape))]}],
    }
    (folder / "found.json").write_text(json.dumps(content))
    return str(folder / "found.json")


def write_pts_fits(folder: Path, shape: np.ndarray) -> str:
    (folder / "found").mkdir()
    counts: dict[str, int] = {}
    for name, points in fitted(shape):
        stem = Path(name).stem
        counts[stem] = counts.get(stem, 0) + 1
        lines = [f"{x + 1} {y + 1}" for x, y in points]  # they count pixels from 1
        file = folder / "found" / f"{stem}_{counts[stem]}.pts"
        file.write_text("\n".join(["version: 1", f"n_points: {len(points)}", "{", *lines, "}"]))
    return str(folder / "found")


def mediapipe_shape() -> np.ndarray:
    """The points of MediaPipe's mesh on the face, as far as the 68 say where they are; others lie beside them."""
    shape = np.random.default_rng(1).uniform(-300, 300, (478, 2))
    for point, (vertex,) in zip(shape_of_face(), sources(MEDIAPIPE478, IBUG68), strict=True):
        shape[vertex] = point
    return shape


def compared(labels: str, *contestants: str, **run: Any) -> Comparison:
    (found,) = plan_comparison(read_contestants(contestants), [labels], EvaluationRun(**run)).compare()
    return found


@pytest.mark.parametrize(
    ("write", "shape"),
    [
        (write_csv_fits, shape_of_face()),
        (write_json_lines_fits, shape_of_face()),
        (write_coco_fits, shape_of_face()),
        (write_pts_fits, shape_of_face()),
        (write_csv_fits, mediapipe_shape()),
    ],
    ids=["csv", "jsonl", "coco", "pts", "mediapipe"],
)
def test_fits_of_another_program_are_measured_as_by_hand(
    tmp_path: Path, labels: str, write: Callable[[Path, np.ndarray], str], shape: np.ndarray
) -> None:
    found = compared(labels, f"theirs={write(tmp_path, shape)}")
    assert (found.scheme, found.normaliser) == (IBUG68, "outer")
    np.testing.assert_allclose(found.errors["theirs"], by_hand(), atol=1e-6)
    (entry,) = found.entries
    assert entry.extra == 1  # of those in pictures of the dataset
    lost = [problem.row for problem in entry.evaluation.fits.problems]
    assert lost == [number for number, off in enumerate(OFF.values()) if off is None]


def test_errors_are_measured_in_what_all_share(tmp_path: Path, labels: str) -> None:
    shape = shape_of_face()
    fine = write_csv_fits(tmp_path, shape)
    points = np.array([shape[list(indices)].mean(0) for indices in sources(IBUG68, AFLW21)])
    (tmp_path / "coarse").mkdir()
    coarse = write_csv_fits(tmp_path / "coarse", points)
    contestants = read_contestants([f"fine={fine}", f"coarse={coarse}"])
    plan = plan_comparison(contestants, [labels])
    (found,) = plan.compare()
    assert found.scheme == AFLW21
    assert f"{labels}: errors are measured in aflw21, which the labels are converted to" in plan.notes
    assert f"{labels}: fine's landmarks are converted from ibug68" in plan.notes
    # Of points that are means, as others, all are off alike.
    for errors in found.errors.values():
        np.testing.assert_allclose(errors, by_hand(), atol=1e-6)


def test_the_order_of_rows_and_of_faces_is_nothing(tmp_path: Path, labels: str) -> None:
    path = Path(write_csv_fits(tmp_path, shape_of_face()))
    header, *rows = path.read_text().splitlines()
    expected = compared(labels, str(path)).errors["found"]
    for seed in range(3):
        shuffled = np.random.default_rng(seed).permutation(rows)
        path.write_text("\n".join([header, *shuffled]))
        np.testing.assert_array_equal(compared(labels, str(path)).errors["found"], expected)


def test_a_fit_is_one_face_at_most_and_the_nearest(tmp_path: Path, labels: str) -> None:
    # Two fits on the first face of a.png, none on the others: the better counts, the other is no face.
    first, second = (shape_of_face() + PLACES["a.png"][0] + off for off in ((9, 0), (1, 0)))
    rows = [",".join(["a.png", *map(str, points.ravel())]) for points in (first, second)]
    (tmp_path / "twice.csv").write_text("\n".join([",".join(["image", *_columns(68)]), *rows]))
    found = compared(labels, f"twice={tmp_path / 'twice.csv'}")
    np.testing.assert_allclose(found.errors["twice"], [1 / 50, *[math.inf] * 6], atol=1e-6)
    assert found.entries[0].extra == 1


@pytest.mark.parametrize("order", ["roll-pitch-yaw", "roll-yaw-pitch", ""])
@pytest.mark.parametrize("boxed", [True, False])
def test_poses_alone_are_measured_too(tmp_path: Path, labels: str, order: str, boxed: bool) -> None:
    # In the order that the file names; where nobody says where a face is, only single faces of pictures have a pose.
    header = ["image", "roll", "pitch", "yaw", "pose_order", *["x", "y", "width", "height"] * boxed]
    rows = []
    for (name, number), off in OFF.items():
        if off is not None:
            pose = np.array([POSES[name, number]])
            given = in_order(pose, ["roll-yaw-pitch"])[0] if order == "roll-yaw-pitch" else pose[0]
            box = [PLACES[name][number][0] - 10, PLACES[name][number][1] - 10, 130, 130] * boxed
            rows.append(",".join(map(str, [name, *given + [0, 0, 2], order, *box])))
    (tmp_path / "poses.csv").write_text("\n".join([",".join(header), *rows]))
    found = compared(labels, f"posed={tmp_path / 'poses.csv'}")
    assert not found.errors
    known = [off is not None and (boxed or len(PLACES[name]) == 1) for (name, _), off in OFF.items()]
    assert np.isfinite(found.poses["posed"]).all(1).tolist() == known
    difference = found.poses["posed"][known] - found.true_pose[known]
    expected = [0, 0, 2]
    if order == "roll-yaw-pitch":  # two degrees more of yaw are something else in another order
        assert np.abs(difference).max() < 3
    else:
        np.testing.assert_allclose(difference, [expected] * sum(known), atol=1e-9)


def test_no_pose_is_lost_on_the_way_to_another_order_and_back() -> None:
    rng = np.random.default_rng(0)
    poses = np.stack([rng.uniform(-90, 90, 50), rng.uniform(-60, 60, 50), rng.uniform(-80, 80, 50)], 1)
    there = in_order(poses, ["roll-yaw-pitch"] * 50)
    back = in_order(there, ["roll-pitch-yaw"] * 50, ["roll-yaw-pitch"] * 50)
    np.testing.assert_allclose(back, poses, atol=1e-8)
    np.testing.assert_array_equal(in_order(there, ["roll-yaw-pitch"] * 50, ["roll-yaw-pitch"] * 50), there)


HEADER = ",".join(["image", *_columns(68)])
ROW = ",".join(["a.png", *["1"] * 136])


@pytest.mark.parametrize(
    ("spec", "content", "kind", "message"),
    [
        ("x.txt", "", InputError, "expected a model .* or a file of fits"),
        ("nothing.csv", None, DatasetError, "nothing.csv: expected a CSV table"),
        ("empty.csv", HEADER, DatasetError, "empty.csv: expected fits of faces; found none"),
        ("bad.csv", "image,x1\na.png,3", DatasetError, "x1 without its y"),
        ("order.csv", "image,roll,pitch,yaw,pose_order\na.png,1,2,3,yaw-first", DatasetError, "expected a pose_order"),
        ("bad.jsonl", "[1]\n{\n", DatasetError, "bad.jsonl, line 1: expected an object of a face"),
        ("odd.jsonl", '{"image": "a.png", "landmarks": [[1, 2], [3]]}', DatasetError, "odd.jsonl, line 1"),
        ("pts:nowhere", None, DatasetError, "nowhere: expected a folder of .pts files"),
        ("others.csv", f"{HEADER}\nq.png{ROW[5:]}", InputError, "none of its 1 names is one, such as q.png"),
        ("five.csv", "image,x1,y1,x2,y2\na.png,1,1,2,2", InputError, "landmarks that all can be converted to"),
        ("=", None, InputError, "expected a model"),
    ],
)
def test_wrong_contestants_are_refused(
    tmp_path: Path, labels: str, spec: str, content: str | None, kind: type[JaxfitError], message: str
) -> None:
    prefix, colon, name = spec.rpartition(":")
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(kind, match=message):
        compared(labels, f"{prefix}{colon}{tmp_path / name}" if spec != "=" else "=")


def test_names_are_each_ones_own(tmp_path: Path, labels: str) -> None:
    path = write_csv_fits(tmp_path, shape_of_face())
    with pytest.raises(InputError, match="different names"):
        read_contestants([path, path])
    with pytest.raises(InputError, match="got only files of fits"):
        compared(labels, path, boxes=path)
    with pytest.raises(InputError, match="got none"):
        compared(labels)


def test_what_a_file_has_too_much_of_is_said(tmp_path: Path, labels: str) -> None:
    path = Path(write_csv_fits(tmp_path, shape_of_face()))
    path.write_text(path.read_text() + f"\n{ROW},9\n,{ROW[6:]}")
    plan = plan_comparison(read_contestants([str(path)]), [labels])
    assert "found: rows for pictures that no dataset has: 1, such as elsewhere.png" in plan.notes
    assert any("expected a picture's path in the column image" in note for note in plan.notes)


def test_numbers_of_points_mean_schemes(tmp_path: Path) -> None:
    for count, scheme in ((21, "aflw21"), (68, "ibug68"), (478, "mediapipe478"), (27, "points27")):
        (tmp_path / "found.csv").write_text(",".join(["image", *_columns(count)]) + "\na" + ",1" * 2 * count)
        assert read_fits(str(tmp_path / "found.csv")).scheme.name == scheme
