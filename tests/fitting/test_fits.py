"""Laws of `Fits`: some of the faces, one after the other, joined, compared, in a line, and as rows and tables."""

import csv
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxfit.data.rows import PROBLEM, head_columns, landmark_columns, table_text
from jaxfit.data.writers import WRITERS
from jaxfit.errors import InputError
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.models.model import SQUARE
from jaxfit.schemes.known import AFLW21, IBUG68, scheme_named

SCHEME = scheme_named("points5")
PICTURES = np.array([0, 0, 1, 3, 3, 3])  # the third picture has no face
COUNT, LOST = len(PICTURES), 3
MODES = 2
KINDS = ("2D", "2D with confidence", "3D", "3D with confidence", "2D with uncertainty", "3D with uncertainty")


@cache
def made(kind: str, seed: int = 0) -> Fits:
    """Six faces in four pictures; one picture has no face, and one face was not fitted."""
    rng = np.random.default_rng(seed)
    arrays: dict[str, Any] = {"landmarks": rng.normal(100, 30, (COUNT, SCHEME.count, 2))}
    if "3D" in kind:
        arrays |= {"landmarks_3d": rng.normal(100, 30, (COUNT, SCHEME.count, 3)), "pose": rng.normal(0, 20, (COUNT, 3))}
        arrays |= {"scale": rng.uniform(1, 2, COUNT), "b": rng.normal(size=(COUNT, MODES))}
    if "confidence" in kind:
        arrays["confidence"] = np.array([0.9, 0.2, 0.7, 0.5, 0.4, 1.0])
    if "uncertainty" in kind:
        factors = rng.normal(size=(COUNT, SCHEME.count, 2, 2))
        arrays["covariances"] = factors @ factors.swapaxes(2, 3)
        arrays["visible"] = rng.uniform(size=(COUNT, SCHEME.count))
    for values in arrays.values():
        values[LOST] = np.nan
    return Fits(
        scheme=SCHEME,
        names=("in/a.png", "in/b.png", "in/c.png", "d.jpg"),
        sizes=np.array([[640, 480], [320, 200], [30, 20], [800, 600]]),
        pictures=PICTURES,
        boxes=rng.uniform(10, 90, (COUNT, 4)),
        kinds=(SQUARE, "haar-frontal", SQUARE, SQUARE, "dlib", SQUARE),
        rotations=rng.uniform(-40, 40, COUNT),
        problems=(Problem(2, "in/c.png", "no face found"), Problem(3, "d.jpg", "the fit diverged", LOST)),
        **arrays,
    )


@pytest.fixture(params=KINDS)
def fits(request: pytest.FixtureRequest) -> Fits:
    return made(request.param)


def without_faceless(fits: Fits) -> Fits:
    """The fits without what is said of pictures that have no face."""
    return replace(fits, problems=tuple(problem for problem in fits.problems if problem.row is not None))


CHOICES = {
    "number": (2, [2]),
    "last": (-1, [5]),
    "NumPy's number": (np.int64(LOST), [LOST]),
    "slice": (slice(2, 5), [2, 3, 4]),
    "end": (slice(-2, None), [4, 5]),
    "backwards": (slice(None, None, -2), [5, 3, 1]),
    "all": (slice(None), [0, 1, 2, 3, 4, 5]),
    "none": (slice(0, 0), []),
    "mask": (PICTURES == 3, [3, 4, 5]),
    "list of a mask": ([False, True, False, True, False, False], [1, 3]),
    "nobody": (np.zeros(COUNT, bool), []),
    "empty list": ([], []),
    "numbers": ([4, LOST, 0, LOST], [4, 3, 0, 3]),
    "negative numbers": (np.array([-1, -6]), [5, 0]),
}
choices = pytest.mark.parametrize(("chosen", "rows"), CHOICES.values(), ids=CHOICES)


@choices
def test_some_of_the_faces_are_these_faces(fits: Fits, chosen: Any, rows: list[int]) -> None:
    some = fits[chosen]
    assert isinstance(some, Fits)
    assert len(some) == len(rows)
    assert list(some.arrays) == list(fits.arrays)
    for name, values in fits.arrays.items():
        np.testing.assert_array_equal(some.arrays[name], values[rows])
        assert some.arrays[name].dtype == values.dtype
    assert some.kinds == tuple(fits.kinds[row] for row in rows)
    assert (some.scheme, some.names) == (fits.scheme, fits.names)
    np.testing.assert_array_equal(some.sizes, fits.sizes)
    np.testing.assert_array_equal(some.fitted, fits.fitted[rows])
    np.testing.assert_array_equal(some.ok, fits.ok[rows])
    lost = [place for place, row in enumerate(rows) if row == LOST]
    assert some.problems == tuple(Problem(3, "d.jpg", "the fit diverged", place) for place in lost)


@choices
def test_some_of_some_are_some(fits: Fits, chosen: Any, rows: list[int]) -> None:
    for first in (slice(None, None, -1), [0, 3, 3, 5, 1, 2], slice(None)):
        numbers = np.arange(COUNT)[first]
        assert fits[first][chosen] == fits[numbers[rows]]


@pytest.mark.parametrize("wrong", [COUNT, -COUNT - 1, [0, COUNT], np.ones(COUNT - 1, bool), 1.5, "landmarks", (0, 1)])
def test_faces_that_are_not_there_cannot_be_taken(fits: Fits, wrong: Any) -> None:
    with pytest.raises((IndexError, TypeError)):
        fits[wrong]


def test_iteration_gives_each_face_alone(fits: Fits) -> None:
    each = list(fits)
    assert each == [fits[row] for row in range(COUNT)]
    assert [len(face) for face in each] == [1] * COUNT
    assert [face.landmarks.shape for face in each] == [(1, SCHEME.count, 2)] * COUNT
    assert list(fits[:0]) == []


def test_taking_some_changes_nothing(fits: Fits) -> None:
    taken = fits[[1, 2]]
    taken.landmarks[:] = 0
    assert fits.landmarks[1].any()


def parts_of(kind: str) -> list[Fits]:
    return [made(kind, 1), made(kind, 2)[:0], made(kind, 3)[[5, LOST, 0]]]


@pytest.mark.parametrize("kind", KINDS)
def test_a_join_has_the_rows_of_its_parts(kind: str) -> None:
    parts = parts_of(kind)
    whole = Fits.join(parts)
    for name in parts[0].arrays:
        if name != "pictures":
            np.testing.assert_array_equal(whole.arrays[name], np.concatenate([part.arrays[name] for part in parts]))
    assert whole.kinds == sum((part.kinds for part in parts), ())
    assert whole.names == 3 * parts[0].names
    np.testing.assert_array_equal(whole.sizes, np.concatenate([part.sizes for part in parts]))
    assert whole.pictures.tolist() == [0, 0, 1, 3, 3, 3, 11, 11, 8]
    assert whole.pictures.dtype == parts[0].pictures.dtype
    assert whole.problems == (
        Problem(2, "in/c.png", "no face found"),
        Problem(3, "d.jpg", "the fit diverged", LOST),
        Problem(11, "d.jpg", "the fit diverged", 7),
    )
    for problems in (False, True):
        rows = [row for part in parts for row in part.rows(problems=problems)]
        assert list(whole.rows(problems=problems)) == rows
        assert whole.to_dicts(problems) == [row for part in parts for row in part.to_dicts(problems)]


@pytest.mark.parametrize("kind", KINDS)
def test_joins_can_be_taken_apart_and_nested(kind: str) -> None:
    one, two, three = parts_of(kind)
    whole = Fits.join([one, two, three])
    assert Fits.join([one]) == one
    assert Fits.join([Fits.join([one, two]), three]) == Fits.join([one, Fits.join([two, three])]) == whole
    first = whole[: len(one)]
    assert replace(first, names=one.names, sizes=one.sizes) == without_faceless(one)
    assert Fits.join([whole[:4], whole[4:]]).kinds == whole.kinds


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ([], "got none"),
        ([made("2D"), made("3D")], "of one model"),
        ([made("2D"), made("2D with confidence")], "of one model"),
        ([made("2D"), replace(made("2D"), scheme=replace(SCHEME, name="five"))], "of one model"),
        ([made("3D"), replace(made("3D"), b=np.zeros((COUNT, MODES + 1)))], "of one model"),
    ],
    ids=["none", "2D and 3D", "confidence", "schemes", "modes"],
)
def test_what_cannot_be_joined_is_refused(parts: list[Fits], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Fits.join(parts)


def copied(values: Any) -> Any:
    return values.copy() if isinstance(values, np.ndarray) else values


def test_equal_fits_are_equal(fits: Fits) -> None:
    same = Fits(**{field.name: copied(getattr(fits, field.name)) for field in fields(fits)})
    assert fits == same
    assert fits[:0] == same[:0]


def changed(values: Any) -> Any:
    """Other values of this kind."""
    if isinstance(values, np.ndarray):
        other = values.copy()
        other.flat[-1] += 1
        return other
    if isinstance(values, tuple):
        return values[1:]
    return AFLW21 if values is SCHEME else np.zeros(COUNT)


@pytest.mark.parametrize("name", [field.name for field in fields(Fits)])
def test_fits_that_differ_in_anything_are_not_equal(fits: Fits, name: str) -> None:
    other = replace(fits, **{name: changed(getattr(fits, name))})
    assert fits != other
    assert other != fits


def test_fits_are_not_equal_to_other_things_and_have_no_hash(fits: Fits) -> None:
    assert fits != fits[:-1]
    assert fits != 3
    assert fits != fits.landmarks.tolist()
    assert fits.__eq__(None) is NotImplemented
    with pytest.raises(TypeError, match="unhashable"):
        hash(fits)


@pytest.mark.parametrize(
    ("shown", "line"),
    [
        (made("2D"), "<Fits: 6 faces in 4 pictures, 5 landmarks, 2 problems>"),
        (made("2D with confidence"), "<Fits: 6 faces in 4 pictures, 5 landmarks, 2 doubtful, 2 problems>"),
        (made("3D")[1:3], "<Fits: 2 faces in 4 pictures, 5 landmarks, 3D>"),
        (made("3D with confidence")[:0], "<Fits: 0 faces in 4 pictures, 5 landmarks, 3D, 0 doubtful>"),
    ],
)
def test_fits_are_shown_in_one_line(shown: Fits, line: str) -> None:
    assert repr(shown) == str(shown) == line


def test_what_is_fitted_and_what_is_good() -> None:
    plain, confident = made("2D"), made("2D with confidence")
    assert plain.fitted.tolist() == confident.fitted.tolist() == [True, True, True, False, True, True]
    assert plain.ok.tolist() == plain.fitted.tolist()
    assert confident.ok.tolist() == [True, False, True, False, False, True]


def test_rows_name_faces_after_their_pictures(fits: Fits) -> None:
    rows = list(fits.rows())
    assert [row["face"] for row in rows] == ["a_1", "a_2", "b_1", "d_2", "d_3"]  # d_1 was not fitted
    assert [row["image"] for row in rows] == ["in/a.png", "in/a.png", "in/b.png", "d.jpg", "d.jpg"]
    assert [row["face"] for row in fits.rows(["w", "x", "y", "z"])] == ["w_1", "w_2", "x_1", "z_2", "z_3"]
    assert rows[2]["size"] == {"width": 320, "height": 200}
    assert rows[1]["box"]["kind"] == "haar-frontal"
    np.testing.assert_allclose(
        [rows[3]["box"][side] for side in ("x", "y", "width", "height")], fits.boxes[4], atol=6e-4
    )
    for name in ("landmarks", "landmarks_3d", "b", "scale", "confidence"):
        if name in fits.arrays:
            np.testing.assert_allclose([row[name] for row in rows], fits.arrays[name][fits.fitted], atol=6e-4)
    assert list(fits.rows()) == list(fits.rows())  # again and again


def test_problems_are_rows_only_if_asked_for(fits: Fits) -> None:
    rows = list(fits.rows(problems=True))
    assert [row for row in rows if PROBLEM not in row] == list(fits.rows())
    faceless, lost = (row for row in rows if PROBLEM in row)
    assert faceless == {"image": "in/c.png", PROBLEM: "no face found"}
    assert {*lost} == {"image", "face", "size", "box", "ok", PROBLEM}
    assert (lost["image"], lost["face"], lost[PROBLEM]) == ("d.jpg", "d_1", "the fit diverged")
    assert [row["image"] for row in rows] == ["in/a.png"] * 2 + ["in/b.png", "in/c.png"] + ["d.jpg"] * 3


def test_dicts_have_the_columns_and_values_of_the_tables(fits: Fits, tmp_path: Path) -> None:
    WRITERS["csv"](tmp_path, fits.rows())
    tables = {path.stem: list(csv.DictReader(path.read_text().splitlines())) for path in tmp_path.iterdir()}
    assert set(tables) == ({"landmarks", "heads"} if fits.b is not None else {"landmarks"})
    heads = [
        {f"head_{name}": value for name, value in head.items() if name != "ok"} for head in tables.get("heads", [])
    ]
    rows = fits.to_dicts()
    assert [*fits.columns] == [*landmark_columns(SCHEME, fits.confidence is not None, fits.covariances is not None)] + [
        f"head_{name}" for name in (head_columns(SCHEME, MODES)[3:] if heads else ())
    ]
    for number, (row, written) in enumerate(zip(rows, tables["landmarks"], strict=True)):
        assert tuple(row) == fits.columns
        expected = written | (heads[number] if heads else {})
        for name, value in row.items():
            assert expected[name] == table_text(value)


def test_dicts_of_problems_have_all_columns(fits: Fits) -> None:
    rows = fits.to_dicts(problems=True)
    assert {tuple(row) for row in rows} == {(*fits.columns, PROBLEM)}
    assert [row[PROBLEM] for row in rows] == ["", "", "", "no face found", "the fit diverged", "", ""]
    assert [row for row in fits.to_dicts()] == [
        {name: value for name, value in row.items() if name != PROBLEM} for row in rows if not row[PROBLEM]
    ]
    faceless, lost = (row for row in rows if row[PROBLEM])
    assert {name for name, value in faceless.items() if isinstance(value, str)} == {"image", "face", "box", PROBLEM}
    assert all(isinstance(value, str) or np.isnan(value) for value in faceless.values())
    assert (faceless["image"], faceless["face"], faceless["box"]) == ("in/c.png", "", "")
    assert (lost["face"], np.isnan(lost["x"]), np.isnan(lost["x1"])) == ("d_1", False, True)


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_rows_and_dicts_make_data_frames(fits: Fits, library: str) -> None:
    frames = pytest.importorskip(library)
    frame = frames.DataFrame(fits.to_dicts())
    assert tuple(frame.columns) == fits.columns
    np.testing.assert_allclose(frame["x2"], fits.landmarks[fits.fitted, 1, 0], atol=6e-4)
    assert list(frame["face"]) == ["a_1", "a_2", "b_1", "d_2", "d_3"]
    with_problems = frames.DataFrame(fits.to_dicts(problems=True))
    assert tuple(with_problems.columns) == (*fits.columns, PROBLEM)
    assert list(with_problems[PROBLEM]).count("") == 5
    assert with_problems["x2"].to_numpy().dtype == np.float64
    assert np.isnan(with_problems["x2"].to_numpy()).sum() == 2
    first = Fits.join([fits[:0]] + [replace(fits[:0], problems=fits.problems[:1])] * 150 + [fits])
    assert np.isnan(frames.DataFrame(first.to_dicts(problems=True))["x2"].to_numpy()).sum() == 152
    nested = frames.DataFrame(fits.rows())
    assert list(nested["image"]) == list(frame["image"])
    assert [len(points) for points in nested["landmarks"]] == [SCHEME.count] * 5


def test_faces_with_lids_and_lips_say_how_far_these_are_open() -> None:
    landmarks = np.random.default_rng(0).normal(100, 30, (COUNT, IBUG68.count, 2))
    landmarks[LOST] = np.nan
    fits = replace(made("2D"), scheme=IBUG68, landmarks=landmarks)
    assert list(fits.openness) == ["left_eye", "right_eye", "mouth"]
    assert np.isnan(fits.openness["mouth"]).tolist() == (~fits.fitted).tolist()
    for row, flat, face in zip(fits.rows(), fits.to_dicts(), fits[fits.fitted], strict=True):
        for name, (value,) in face.openness.items():
            assert row["openness"][name] == flat[f"{name}_openness"] == pytest.approx(value, abs=5e-4)
    assert made("2D").openness == {}
