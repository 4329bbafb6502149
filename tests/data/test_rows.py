"""Rows of faces: flat ones and those of tables hold the same values under the same names, in one order."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="arg-type,unused-ignore"

from itertools import product

import numpy as np
import pytest
from face_rows import PLAIN, SURE, face_row, rows_of

from jaxfit.data.rows import (
    FLAGS,
    HEAD,
    PROBLEM,
    TEXTS,
    Rows,
    columns_of,
    flat_row,
    head_columns,
    landmark_columns,
    rounded,
    table_values,
)
from jaxfit.schemes.known import AFLW21, IBUG68
from jaxfit.schemes.scheme import Scheme

# Schemes, numbers of modes, confidences; below 0: none.
MODELS = list(product([AFLW21, IBUG68], [None, 0, 4], [-1.0, 0.25]))
every_model = pytest.mark.parametrize(
    ("scheme", "modes", "confidence"), MODELS, ids=[f"{s.name}-{m}-{c}" for s, m, c in MODELS]
)


@every_model
def test_the_columns_of_a_flat_row_are_those_of_its_model(scheme: Scheme, modes: int | None, confidence: float) -> None:
    flat = flat_row(face_row("a.jpg", "a_1", scheme, modes, confidence))
    assert tuple(flat) == columns_of(scheme, modes, confidence >= 0)
    texts = [name for name, value in flat.items() if isinstance(value, str)]
    assert tuple(texts) == TEXTS[:3]
    assert all(isinstance(value, float) for name, value in flat.items() if name not in (*texts, *FLAGS))
    assert isinstance(flat["ok"], bool)


@every_model
def test_tables_hold_the_values_of_flat_rows(scheme: Scheme, modes: int | None, confidence: float) -> None:
    row = face_row("a.jpg", "a_1", scheme, modes, confidence)
    flat = flat_row(row)
    tables = rows_of([row], scheme).tables()
    assert list(tables) == ["landmarks", *["heads"] * (modes is not None)]
    assert tables["landmarks"] == landmark_columns(scheme, confidence >= 0)
    assert modes is None or tables["heads"] == head_columns(scheme, modes)
    columns = []
    for name, names in tables.items():
        # Both tables say whose the values are; in a flat row, all else of heads has a prefix.
        prefixed = [HEAD + column if name == "heads" and column not in (*TEXTS, *FLAGS) else column for column in names]
        assert table_values(name, row) == [flat[column] for column in prefixed]
        columns += [column for column in prefixed if column not in columns]
    assert columns == list(flat)


def test_values_stand_under_their_names() -> None:
    row = SURE[1]
    flat = flat_row(row)
    assert (flat["image"], flat["face"], flat["box"]) == ("1.jpg", "1_1", "haar-frontal")
    assert [flat[name] for name in ("x", "y", "width", "height", "rotation")] == list(row["box"].values())[:5]
    assert [flat["x68"], flat["y68"]] == row["landmarks"][67]
    assert [flat[f"{HEAD}{axis}68"] for axis in "xyz"] == row["landmarks_3d"][67]
    assert [flat[f"{HEAD}{angle}"] for angle in ("roll", "pitch", "yaw")] == list(row["pose"].values())
    assert (flat["confidence"], flat[f"{HEAD}scale"], flat[f"{HEAD}b4"]) == (0.25, 1.5, row["b"][3])


@pytest.mark.parametrize(
    ("row", "flat"),
    [
        ({"image": "a.jpg", PROBLEM: "no face"}, {"image": "a.jpg", "face": "", "box": ""}),
        (
            {
                "image": "a.jpg",
                "face": "a_1",
                "box": {"kind": "square", "x": 1.0, "y": 2.0, "width": 3.0, "height": 4.0},
            },
            {"image": "a.jpg", "face": "a_1", "box": "square", "x": 1.0, "y": 2.0, "width": 3.0, "height": 4.0},
        ),
    ],
    ids=["a picture without a face", "a face that was not fitted"],
)
def test_flat_rows_without_a_fit_have_what_is_known(row: dict, flat: dict) -> None:
    assert flat_row(row) == flat


def test_rows_can_be_iterated_again_and_one_at_a_time() -> None:
    begun = []

    def begin():  # type: ignore[no-untyped-def]
        begun.append(True)
        yield PLAIN[0]
        raise AssertionError("the second row was not asked for")

    rows = Rows(IBUG68, None, False, begin)
    assert begun == []
    assert next(iter(rows)) is next(iter(rows)) is PLAIN[0]
    assert len(begun) == 2
    assert list(rows_of(PLAIN)) == list(rows_of(PLAIN)) == PLAIN


@pytest.mark.parametrize(
    ("values", "plain"),
    [
        (np.float32(0.1), 0.1),
        (np.array([1.23456, -0.0004]), [1.235, 0.0]),
        (np.float32([[0.1, 2 / 3]]), [[0.1, 0.667]]),
        (np.zeros((0, 2)), []),
    ],
    ids=str,
)
def test_numbers_are_rounded_to_thousandths(values: np.ndarray, plain: object) -> None:
    assert rounded(values) == plain
