"""What landmarks mean: how points are mirrored, drawn, normalised and converted from one labelling to another."""

from jaxfit.schemes.conversions import convert
from jaxfit.schemes.known import AFLW21, IBUG68, LFPW27, LFPW29, MEDIAPIPE478, SCHEMES, scheme_named, scheme_of_count
from jaxfit.schemes.normalisers import NORMALISERS, Normaliser
from jaxfit.schemes.openness import Opening, openings_of, openness
from jaxfit.schemes.own import OwnScheme, own_scheme
from jaxfit.schemes.scheme import Scheme, mirrored

__all__ = [
    "AFLW21",
    "IBUG68",
    "LFPW27",
    "LFPW29",
    "MEDIAPIPE478",
    "NORMALISERS",
    "SCHEMES",
    "Normaliser",
    "Opening",
    "OwnScheme",
    "Scheme",
    "convert",
    "mirrored",
    "openings_of",
    "openness",
    "own_scheme",
    "scheme_named",
    "scheme_of_count",
]
