"""Schemes of one's own: what a small table says of points that are no face's, or of another face's."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

from jaxfit.errors import InputError
from jaxfit.schemes.known import NO_LANDMARKS, SCHEMES, scheme_named
from jaxfit.schemes.normalisers import NORMALISERS
from jaxfit.schemes.scheme import Scheme, is_name

_WHOLE = ", ".join(f'"{name}"' for name, each in NORMALISERS.items() if each.ends is None)  # lengths of any points
_KEYS = ("name", "points", "mirror", "lines", "normaliser", "unit", "scale")


@dataclass(frozen=True)
class OwnScheme:
    """A scheme as its table says it, which need not say all: the rest is as the labels have it.

    Attributes:
        name: of the scheme; None: that of the labels.
        names: of the points; None: those of the labels.
        count: how many points there are; None: as many as the labels have.
        mirror: pairs of points that are mirror images of each other, by name or number from 1; all others are their
            own. None: objects are not symmetric, and are not mirrored in training.
        lines: points that overlays join, one after the other; None: those of the labels.
        normaliser: ``box``, ``area``, ``diagonal``, ``size``, or two points; None: that of the labels.
        unit: of the scale, such as ``mm``.
        scale: the length of a pixel in units, of pictures whose labels do not say it; None: unknown.
    """

    name: str | None = None
    names: tuple[str, ...] | None = None
    count: int | None = None
    mirror: tuple[tuple[str | int, ...], ...] | None = None
    lines: tuple[tuple[str | int, ...], ...] | None = None
    normaliser: str | tuple[str | int, ...] | None = None
    unit: str = ""
    scale: float | None = None

    def of(self, labels: Scheme) -> Scheme:
        """The scheme, for labels of another one.

        Raises:
            InputError: there are points that the labels do not have.
        """
        count = self.count or labels.count
        names = labels.names if self.names is None and count == labels.count else self.names or ()

        def index(point: str | int) -> int:
            if isinstance(point, str) and point in names:
                return names.index(point)
            if isinstance(point, int) and 1 <= point <= count:
                return point - 1
            called = f", or among {', '.join(names)}" if names else ""
            raise InputError(f"scheme: expected points 1 to {count}{called}; got {point!r}")

        mirror = None
        if self.mirror is not None:
            order = list(range(count))
            for one, other in (map(index, pair) for pair in self.mirror):
                order[one], order[other] = other, one
            mirror = tuple(order)
        ends = None
        if isinstance(self.normaliser, tuple):
            one, other = map(index, self.normaliser)
            ends = (one, other)
        lines = labels.lines if count == labels.count else ()
        return Scheme(
            name=self.name or f"points{count}",
            count=count,
            mirror=mirror,
            lines=lines if self.lines is None else tuple(tuple(map(index, line)) for line in self.lines),
            names=names,
            normaliser="ends" if ends else self.normaliser if isinstance(self.normaliser, str) else None,
            ends=ends,
            unit=self.unit,
        )


def own_scheme(values: Mapping[str, Any]) -> OwnScheme:
    """The scheme that a table says: ``name``, ``points`` (names, or a number), ``mirror`` (pairs), ``lines``,
    ``normaliser`` (``"box"``, ``"area"``, ``"diagonal"``, ``"size"``, or two points), ``unit`` and ``scale``. All may
    be missing.

    Raises:
        InputError: there is another key, or a value that is none of these.
    """
    if unknown := [key for key in values if key not in _KEYS]:
        raise InputError(f"scheme: unknown key {unknown[0]!r}; expected some of {', '.join(_KEYS)}")
    name, points, normaliser = values.get("name"), values.get("points"), values.get("normaliser")
    if name is not None:
        _require("name", name, is_name(name) and name not in {*SCHEMES, NO_LANDMARKS.name}, "a new name")
    names, count = None, None
    if isinstance(points, list):
        _require("points", points, bool(points) and all(map(is_name, points)), "names of points")
        _require("points", points, len({*points}) == len(points), "different names")
        names, count = tuple(points), len(points)
    elif points is not None:
        whole = isinstance(points, int) and not isinstance(points, bool) and 0 < points < 1_000_000
        _require("points", points, whole, "names of points, or how many there are")
        count = points
    usual = isinstance(normaliser, str) and normaliser in NORMALISERS and NORMALISERS[normaliser].ends is None
    pair = tuple(normaliser) if _are_points(normaliser, 2) else None
    _require("normaliser", normaliser, normaliser is None or usual or pair is not None, f"{_WHOLE}, or two points")
    mirror = values.get("mirror")
    if mirror is not None:
        good = isinstance(mirror, list) and all(_are_points(each, 2) for each in mirror)
        _require("mirror", mirror, good, "pairs of points, as [[1, 4], [2, 3]]")
        paired = [point for pair in mirror for point in pair]
        _require("mirror", mirror, len({*paired}) == len(paired), "each point in one pair")
    lines = values.get("lines")
    if lines is not None:
        _require("lines", lines, isinstance(lines, list) and all(map(_are_points, lines)), "lists of points")
    unit, scale = values.get("unit", ""), values.get("scale")
    _require("unit", unit, unit == "" or is_name(unit), "a word")
    number = isinstance(scale, int | float) and not isinstance(scale, bool) and 0 < scale < 1e12
    _require("scale", scale, scale is None or number, "the length of a pixel in units, above 0")
    return OwnScheme(
        name=name,
        names=names,
        count=count,
        mirror=None if mirror is None else tuple(map(tuple, mirror)),
        lines=None if lines is None else tuple(map(tuple, lines)),
        normaliser=normaliser if pair is None else pair,
        unit=unit,
        scale=None if scale is None else float(scale),
    )


def scheme_json(scheme: Scheme) -> str | dict[str, Any]:
    """A scheme as files keep it: its name if that says all, else a table."""
    try:
        if scheme_named(scheme.name) == scheme:
            return scheme.name
    except InputError:
        pass
    return {
        "name": scheme.name,
        "count": scheme.count,
        "mirror": scheme.mirror,
        "lines": scheme.lines,
        "names": scheme.names,
        "normaliser": scheme.normaliser,
        "ends": scheme.ends,
        "unit": scheme.unit,
    }


def scheme_of_json(value: object) -> Scheme:
    """The scheme that `scheme_json` made a value of.

    Raises:
        InputError, TypeError, KeyError: it is none.
    """
    if not isinstance(value, dict):
        return scheme_named(str(value))
    names, unit, normaliser = tuple(value["names"]), value["unit"], value["normaliser"]
    if not (is_name(value["name"]) and value["name"] not in SCHEMES and all(map(is_name, names))):
        raise InputError(f"expected the name of a scheme of your own, and of its points; got {value['name']!r}")
    if not (isinstance(value["count"], int) and (unit == "" or is_name(unit)) and normaliser in (None, *NORMALISERS)):
        raise InputError(f"expected a scheme of your own; got {value!r}")
    ends = None if value["ends"] is None else (int(value["ends"][0]), int(value["ends"][1]))
    scheme = Scheme(
        name=value["name"],
        count=value["count"],
        mirror=None if value["mirror"] is None else tuple(map(int, value["mirror"])),
        lines=tuple(tuple(map(int, line)) for line in value["lines"]),
        names=names,
        normaliser=normaliser,
        ends=ends,
        unit=unit,
    )
    if normaliser is not None and not NORMALISERS[normaliser].known_of(scheme):
        raise InputError(f"scheme {scheme.name}: expected what the normaliser {normaliser} needs; it is missing")
    return scheme


def scheme_text(scheme: Scheme) -> str:
    """What `scheme_json` gives, as text."""
    value = scheme_json(scheme)
    return value if isinstance(value, str) else json.dumps(value)


def read_scheme_text(text: str) -> Scheme:
    """The scheme that `scheme_text` made a text of.

    Raises:
        InputError, TypeError, KeyError: it is none.
    """
    return scheme_of_json(json.loads(text) if text.startswith("{") else text)


def _are_points(value: object, count: int | None = None) -> TypeGuard[list[str | int]]:
    return (
        isinstance(value, list)
        and bool(value)
        and (count is None or len(value) == count)
        and all(is_name(point) or (isinstance(point, int) and not isinstance(point, bool)) for point in value)
    )


def _require(key: str, value: object, good: bool, expected: str) -> None:
    if not good:
        raise InputError(f"scheme: {key}: expected {expected}; got {value!r}")


def numbered(names: Sequence[str]) -> bool:
    """Whether names of points are only their numbers, from 0 or 1, in their order; also if there are none."""
    return not names or any(
        list(names) == [f"{first + n:0{len(names[0])}d}" for n in range(len(names))] for first in (0, 1)
    )
