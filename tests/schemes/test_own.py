"""Schemes of one's own: what their tables say, what they may not say, and that files keep them."""

import json
from typing import Any

import numpy as np
import pytest

from jaxfit.errors import InputError
from jaxfit.labels.datasets import scheme_values
from jaxfit.schemes.conversions import convert, convertible
from jaxfit.schemes.known import AFLW21, IBUG68, scheme_named
from jaxfit.schemes.normalisers import default_normaliser, normaliser_length
from jaxfit.schemes.own import own_scheme, read_scheme_text, scheme_json, scheme_of_json, scheme_text
from jaxfit.schemes.scheme import Scheme

FOUR = scheme_named("points4")
WING: dict[str, Any] = {
    "name": "wing",
    "points": ["tip", "root", "front", "back"],
    "mirror": [["front", "back"]],
    "lines": [["root", "front", 1], ["root", "back"]],
    "normaliser": ["root", 1],
    "unit": "mm",
    "scale": 0.2,
}


def test_a_table_says_all() -> None:
    found = own_scheme(WING).of(FOUR)
    assert found == Scheme(
        name="wing",
        count=4,
        mirror=(0, 1, 3, 2),
        lines=((1, 2, 0), (1, 3)),
        names=("tip", "root", "front", "back"),
        normaliser="ends",
        ends=(1, 0),
        unit="mm",
    )
    truth = np.array([[0.0, 0], [3, 4], [9, 9], [7, 1]])
    assert default_normaliser(found) == "ends"
    assert normaliser_length(truth, found, "ends") == 5


def test_what_a_table_does_not_say_is_as_the_labels_have_it() -> None:
    labels = Scheme("points4", 4, lines=((0, 1),), names=("a", "b", "c", "d"))
    assert own_scheme({}).of(labels) == labels
    assert own_scheme({"mirror": [["a", 2]]}).of(labels).mirror == (1, 0, 2, 3)
    # Faces of a known scheme that are none lose what only faces have.
    plain = own_scheme({"points": 21}).of(AFLW21)
    assert (plain.name, plain.mirror, plain.outer_eyes, default_normaliser(plain)) == ("points21", None, None, "box")


@pytest.mark.parametrize("count", [1, 2, 3, 13, 200])
def test_any_number_of_points(count: int) -> None:
    found = own_scheme({"mirror": [[1, count]] if count > 1 else []}).of(scheme_named(f"points{count}"))
    assert scheme_of_json(json.loads(json.dumps(scheme_json(found)))) == found
    assert sorted(found.mirror or ()) == list(range(count))
    points = np.random.default_rng(0).uniform(0, 9, (count, 2))
    size = normaliser_length(points, found, "size")
    expected = np.sqrt(((points - points.mean(0)) ** 2).sum())
    assert np.isnan(size) if count == 1 else np.isclose(size, expected)


@pytest.mark.parametrize("scheme", [own_scheme(WING).of(FOUR), FOUR, IBUG68, own_scheme({"name": "x"}).of(FOUR)])
def test_files_keep_schemes(scheme: Scheme) -> None:
    assert read_scheme_text(scheme_text(scheme)) == scheme
    assert (scheme_text(scheme) == scheme.name) == (scheme in (FOUR, IBUG68))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"colour": "red"}, "unknown key 'colour'"),
        ({"name": "ibug68"}, "name: expected a new name"),
        ({"name": "a\nb"}, "name: expected a new name"),
        ({"points": ["a", "a", "b", "c"]}, "points: expected different names"),
        ({"points": []}, "points: expected names"),
        ({"points": 0}, "points: expected names of points, or how many"),
        ({"points": 5}, "need points of the same names, or as many"),
        ({"mirror": [["tip", "root"], ["tip", "back"]]}, "mirror: expected each point in one pair"),
        ({"mirror": [["tip"]]}, "mirror: expected pairs"),
        ({"mirror": [["tip", "wing"]]}, "expected points 1 to 4, or among tip, .*; got 'wing'"),
        ({"mirror": [[0, 1]]}, "expected points 1 to 4.*; got 0"),
        ({"lines": [1, 2]}, "lines: expected lists of points"),
        ({"normaliser": "outer"}, "normaliser: expected"),
        ({"normaliser": ["tip", "tip"]}, "two different points"),
        ({"unit": 3}, "unit: expected a word"),
        ({"scale": 0}, "scale: expected the length of a pixel"),
        ({"scale": True}, "scale: expected the length of a pixel"),
    ],
)
def test_tables_that_are_no_schemes(changed: dict[str, Any], message: str) -> None:
    usual = WING if not {"points"} & changed.keys() else {}
    with pytest.raises(InputError, match=message):
        convert(np.zeros((4, 2)), FOUR, own_scheme(usual | changed).of(FOUR))


def test_points_of_the_same_name_are_the_same() -> None:
    wing = own_scheme(WING).of(FOUR)
    other = Scheme("points5", 5, names=("back", "x", "tip", "root", "front"))
    points = np.arange(10.0).reshape(5, 2)
    np.testing.assert_array_equal(convert(points, other, wing), points[[2, 3, 4, 0]])
    assert not convertible(wing, other)
    assert convertible(FOUR, wing)
    assert convertible(wing, FOUR)
    assert not convertible(IBUG68, wing)
    assert not convertible(AFLW21, IBUG68)


def test_schemes_from_files_and_text(tmp_path) -> None:
    (tmp_path / "fly.toml").write_text("points = 3\nmirror = [[1, 3]]\n")
    assert scheme_values(str(tmp_path / "fly.toml")) == {"name": "fly", "points": 3, "mirror": [[1, 3]]}
    assert scheme_values("{mirror = [[1, 3]]}") == {"mirror": [[1, 3]]}
    assert scheme_values("points7") == "points7"
    (tmp_path / "bad.toml").write_text("points = \n")
    for text, message in {
        str(tmp_path / "no.toml"): "cannot be read",
        str(tmp_path / "bad.toml"): "bad.toml: expected a scheme in TOML",
        "{mirror = [1]}": "mirror: expected pairs",
        "{": "expected a scheme in TOML",
        "what": "unknown landmark scheme 'what'",
    }.items():
        with pytest.raises(InputError, match=message):
            scheme_values(text)


@pytest.mark.parametrize("broken", ["name", "names", "mirror", "lines", "ends", "normaliser", "count", "unit"])
def test_damaged_schemes_in_files_are_refused(broken: str) -> None:
    value = scheme_json(own_scheme(WING).of(FOUR))
    assert isinstance(value, dict)
    damage: dict[str, Any] = {"name": "\0", "names": ["a"], "mirror": [1, 2, 3, 0], "lines": [[9]], "ends": None}
    damage |= {"normaliser": "outer", "count": "4", "unit": 7}
    with pytest.raises(InputError):
        scheme_of_json(value | {broken: damage[broken]})
