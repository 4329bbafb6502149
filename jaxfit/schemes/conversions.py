"""Landmarks of one scheme from those of another: every point the mean of some points of the source."""

import numpy as np

from jaxfit.errors import InputError
from jaxfit.schemes.known import AFLW21, IBUG68, LFPW27, LFPW27_NAMES, LFPW29, LFPW29_NAMES, MEDIAPIPE478, SCHEMES
from jaxfit.schemes.scheme import Scheme

# For each point of the target, in its order, the 0-based indices of the source points that it is the mean of.
Sources = tuple[tuple[int, ...], ...]

_LEFT_EYE, _RIGHT_EYE = tuple(range(36, 42)), tuple(range(42, 48))
_INNER_LIPS = tuple(range(60, 68))

# By the names of the source and the target.
CONVERSIONS: dict[tuple[str, str], Sources] = {
    (IBUG68.name, AFLW21.name): (
        *((17,), (19,), (21,), (22,), (24,), (26,)),  # brows
        *((36,), _LEFT_EYE, (39,), (42,), _RIGHT_EYE, (45,)),
        # iBUG's do not show the ears (the first and the last here): the face's outline stands in for them.
        *((2,), (31,), (30,), (35,), (14,)),
        *((48,), _INNER_LIPS, (54,), (8,)),  # mouth and chin
    ),
    (IBUG68.name, LFPW27.name): (
        *((17,), (26,), (21,), (22,), (19,), (24,)),  # brows
        *((36,), (45,), (39,), (42,)),  # corners of the eyes
        *((37, 38), (40, 41), (43, 44), (46, 47)),  # lids
        *(_LEFT_EYE, _RIGHT_EYE),  # pupils
        *((31,), (35,), (30,), (33,)),  # nose
        *((48,), (54,), (51,), (62,), (66,), (57,), (8,)),  # mouth and chin
    ),
    (LFPW29.name, LFPW27.name): tuple((LFPW29_NAMES.index(name),) for name in LFPW27_NAMES),
}


def _through(first: Sources, then: Sources) -> Sources:
    """One conversion after another, of which the first takes each point from a single one."""
    return tuple(tuple(first[index][0] for index in indices) for indices in then)


# MediaPipe's mesh has no points that are meant to be the 68. Of each of these and its mirror image, this is the pair of
# vertices, mirror images too, that lay nearest to the labels of 798 faces of LFPW's and HELEN's training pictures, on
# average. Mean error there, relative to the outer corners: 0.047; of a map that many programs use (its outline: 162,
# 234, 93, ...; its brows: 71, ..., 301), 0.053.
_FROM_MEDIAPIPE: Sources = tuple(
    (index,)
    for index in (
        *(127, 227, 177, 215, 172, 136, 149, 148, 152, 377, 378, 365, 397, 435, 401, 447, 356),  # outline
        *(70, 63, 105, 66, 107, 336, 296, 334, 293, 300),  # brows
        *(168, 197, 195, 4, 75, 97, 2, 326, 305),  # nose
        *(33, 160, 158, 155, 153, 144, 382, 385, 387, 263, 373, 380),  # eyes
        *(61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181),  # outer lips
        *(78, 82, 13, 312, 308, 317, 14, 87),  # inner lips
    )
)
CONVERSIONS |= {(MEDIAPIPE478.name, IBUG68.name): _FROM_MEDIAPIPE} | {
    (MEDIAPIPE478.name, target.name): _through(_FROM_MEDIAPIPE, CONVERSIONS[IBUG68.name, target.name])
    for target in (AFLW21, LFPW27)
}


def sources(source: Scheme, target: Scheme) -> Sources:
    """For each point of ``target``, the points of ``source`` that it is the mean of; itself if the schemes are equal.

    Where both name their points, points of the same name are the same. Else schemes with as many points have the same
    ones in the same order, unless both are known ones.

    Raises:
        InputError: the conversion is not known.
    """
    found = _sources(source, target)
    if found is None:
        known = ", ".join(" to ".join(names) for names in CONVERSIONS)
        raise InputError(
            f"cannot convert landmarks from {described(source)} to {described(target)}; known conversions: {known}; "
            "schemes of your own need points of the same names, or as many"
        )
    return found


def convertible(source: Scheme, target: Scheme) -> bool:
    """Whether landmarks of a scheme have to be converted to be of another, and can be."""
    return source != target and _sources(source, target) is not None


def described(scheme: Scheme) -> str:
    """A scheme's name, for messages, with its first points where these have names."""
    some = ", ".join(scheme.names[:3]) + (", ..." if scheme.count > 3 else "")
    return f"{scheme.name} ({some})" if scheme.names else scheme.name


def _sources(source: Scheme, target: Scheme) -> Sources | None:
    if source == target:
        return tuple((index,) for index in range(source.count))
    if (source.name, target.name) in CONVERSIONS:
        return CONVERSIONS[source.name, target.name]
    if source.names and target.names:
        places = {name: index for index, name in enumerate(source.names)}
        return tuple((places[name],) for name in target.names) if {*target.names} <= places.keys() else None
    if source.count == target.count > 0 and not {source.name, target.name} <= SCHEMES.keys():
        return tuple((index,) for index in range(source.count))
    return None


def convert(landmarks: np.ndarray, source: Scheme, target: Scheme) -> np.ndarray:
    """Landmarks (..., L, D) of the scheme ``source`` as landmarks (..., M, D) of ``target``; what depends on a NaN is
    NaN.

    Raises:
        InputError: the conversion is not known, or ``landmarks`` are not of ``source``.
    """
    points = np.asarray(landmarks)
    if points.shape[-2:] not in ((source.count, 2), (source.count, 3)):
        raise InputError(
            f"landmarks of scheme {source.name} must be (..., {source.count}, 2) or (..., {source.count}, 3); "
            f"got {points.shape}"
        )
    return np.stack([points[..., list(indices), :].mean(-2) for indices in sources(source, target)], -2)
