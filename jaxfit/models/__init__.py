"""Models and their files: saving, loading, the ones that come with the package, and how faces lie in boxes."""

from jaxfit.models.cards import Card, read_cards
from jaxfit.models.files import bundled, load, save
from jaxfit.models.model import Model
from jaxfit.models.placements import Placement

__all__ = ["Card", "Model", "Placement", "bundled", "load", "read_cards", "save"]
