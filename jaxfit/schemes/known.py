"""The schemes that are known: 21-, 27-, 29- and 68-point faces.

Indices are 0-based. "Left" and "right" are those of the picture, not of the subject.
"""

from collections.abc import Collection, Iterable

from jaxfit.errors import InputError
from jaxfit.schemes.scheme import Scheme


def _mirror(count: int, pairs: list[tuple[int, int]]) -> tuple[int, ...]:
    order = list(range(count))
    for a, b in pairs:
        order[a], order[b] = b, a
    return tuple(order)


def _without(scheme: Scheme, dropped: Collection[int], name: str) -> Scheme:
    """The scheme without some of its points, none of which may belong to an eye; outlines lose corners."""
    kept = [index for index in range(scheme.count) if index not in dropped]
    new = {old: index for index, old in enumerate(kept)}

    def renamed(indices: Iterable[int]) -> tuple[int, ...]:
        return tuple(new[index] for index in indices if index in new)

    return Scheme(
        name=name,
        count=len(kept),
        outer_eyes=scheme.outer_eyes and (new[scheme.outer_eyes[0]], new[scheme.outer_eyes[1]]),
        pupils=scheme.pupils and (renamed(scheme.pupils[0]), renamed(scheme.pupils[1])),
        mirror=scheme.mirror and renamed(scheme.mirror[old] for old in kept),
        lines=tuple(map(renamed, scheme.lines)),
    )


def _run(first: int, last: int, closed: bool = False) -> tuple[int, ...]:
    points = tuple(range(first, last + 1))
    return (*points, first) if closed else points


IBUG68 = Scheme(
    name="ibug68",
    count=68,
    outer_eyes=(36, 45),
    pupils=(_run(36, 41), _run(42, 47)),
    mirror=_mirror(
        68,
        [(i, 16 - i) for i in range(8)]
        + [(17 + i, 26 - i) for i in range(5)]
        + [(31, 35), (32, 34)]
        + [(36, 45), (37, 44), (38, 43), (39, 42), (41, 46), (40, 47)]
        + [(48, 54), (49, 53), (50, 52), (59, 55), (58, 56), (60, 64), (61, 63), (67, 65)],
    ),
    lines=(
        _run(0, 16),
        _run(17, 21),
        _run(22, 26),
        _run(27, 30),
        _run(31, 35),
        _run(36, 41, closed=True),
        _run(42, 47, closed=True),
        _run(48, 59, closed=True),
        _run(60, 67, closed=True),
    ),
)

# AFLW's feature_id 1..21 in order: three points a brow, three an eye (corner, centre, corner), ears, nose, mouth, chin.
AFLW21 = Scheme(
    name="aflw21",
    count=21,
    outer_eyes=(6, 11),
    pupils=((7,), (10,)),
    mirror=_mirror(21, [(0, 5), (1, 4), (2, 3), (6, 11), (7, 10), (8, 9), (12, 16), (13, 15), (17, 19)]),
    lines=((0, 1, 2), (3, 4, 5), (6, 7, 8), (9, 10, 11), (13, 14, 15), (17, 18, 19), (12, 20, 16)),
)

# The order of LFPW's file: its first 28 names, then the chin. Names come as left/right pairs.
LFPW29_NAMES = (
    "left_eyebrow_out",
    "right_eyebrow_out",
    "left_eyebrow_in",
    "right_eyebrow_in",
    "left_eyebrow_center_top",
    "left_eyebrow_center_bottom",
    "right_eyebrow_center_top",
    "right_eyebrow_center_bottom",
    "left_eye_out",
    "right_eye_out",
    "left_eye_in",
    "right_eye_in",
    "left_eye_center_top",
    "left_eye_center_bottom",
    "right_eye_center_top",
    "right_eye_center_bottom",
    "left_eye_pupil",
    "right_eye_pupil",
    "left_nose_out",
    "right_nose_out",
    "nose_center_top",
    "nose_center_bottom",
    "left_mouth_out",
    "right_mouth_out",
    "mouth_center_top_lip_top",
    "mouth_center_top_lip_bottom",
    "mouth_center_bottom_lip_top",
    "mouth_center_bottom_lip_bottom",
    "chin",
)

LFPW29 = Scheme(
    name="lfpw29",
    count=29,
    outer_eyes=(8, 9),
    pupils=((16,), (17,)),
    mirror=_mirror(
        29,
        [(0, 1), (2, 3), (4, 6), (5, 7), (8, 9), (10, 11), (12, 14), (13, 15), (16, 17), (18, 19), (22, 23)],
    ),
    lines=(
        (0, 4, 2, 5, 0),
        (3, 6, 1, 7, 3),
        (8, 12, 10, 13, 8),
        (11, 14, 9, 15, 11),
        (18, 20, 19, 21, 18),
        (22, 24, 23, 27, 22),
        (22, 25, 23, 26, 22),
    ),
)

# LFPW's points that 68-point labels can give: those know nothing of the brows' lower edges.
_LOWER_BROWS = ("left_eyebrow_center_bottom", "right_eyebrow_center_bottom")
LFPW27_NAMES = tuple(name for name in LFPW29_NAMES if name not in _LOWER_BROWS)
LFPW27 = _without(LFPW29, [LFPW29_NAMES.index(name) for name in _LOWER_BROWS], "lfpw27")

# MediaPipe's face mesh with its ten points of the irises. The pupils are the means of the lids' points that become the
# 68's, so that errors over their distance are relative to the same length; nothing needs its mirror images.
MEDIAPIPE478 = Scheme(
    name="mediapipe478",
    count=478,
    outer_eyes=(33, 263),
    pupils=((33, 160, 158, 155, 153, 144), (382, 385, 387, 263, 373, 380)),
)

# Faces of which only the box and the pose are known. No model has it, and no option names it.
NO_LANDMARKS = Scheme(name="none", count=0)

SCHEMES = {scheme.name: scheme for scheme in (AFLW21, LFPW27, LFPW29, IBUG68)}
# Schemes that only other programs' fits come in: no labels are of them, and no head model has their points.
FOREIGN = {MEDIAPIPE478.name: MEDIAPIPE478}


def scheme_named(name: str) -> Scheme:
    """The scheme called ``name``; ``points<N>`` names N points of unknown meaning.

    Raises:
        InputError: no such scheme.
    """
    if name in SCHEMES or name in FOREIGN:
        return SCHEMES.get(name) or FOREIGN[name]
    count = name.removeprefix("points")
    if name != count and len(count) < 10 and count.isdecimal() and int(count) > 0:
        return Scheme(name=name, count=int(count))
    raise InputError(f"unknown landmark scheme {name!r}; known: {', '.join(SCHEMES)}, points<N>")


def scheme_of_count(count: int) -> Scheme:
    """The scheme that files of ``count`` points are labelled with, or ``points<count>`` when that is unknown.

    LFPW27 is never guessed: it comes from conversions, and 27 points of a file may be any.
    """
    for scheme in (AFLW21, LFPW29, IBUG68, MEDIAPIPE478):
        if scheme.count == count:
            return scheme
    return Scheme(name=f"points{count}", count=count)


def scheme_of_numbered(scheme: Scheme) -> Scheme:
    """What points that are only numbered mean if they are those of a face: the known scheme of as many points, if there
    is
    one; any other scheme stays as it is."""
    known = scheme_of_count(scheme.count)
    return (
        known if scheme.name == f"points{scheme.count}" and not scheme.names and known.name != scheme.name else scheme
    )
