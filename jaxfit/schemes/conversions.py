"""Landmarks of one scheme from those of another: every point the mean of some points of the source."""

import numpy as np

from jaxfit.errors import InputError
from jaxfit.schemes.known import AFLW21, IBUG68, LFPW27, LFPW27_NAMES, LFPW29, LFPW29_NAMES, SCHEMES
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
    """Landmarks (..., L, D) of the scheme ``source`` as landmarks (..., M, D) of ``target``; what needs a NaN is NaN.

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
