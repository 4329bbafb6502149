"""What is known of the bundled models: a short form of their cards in ``docs/``."""

import json
from dataclasses import dataclass
from importlib import resources

_CARDS = "cards.json"


@dataclass(frozen=True)
class Card:
    """A bundled model in a few lines.

    Attributes:
        summary: what it is for.
        accuracy: its errors, where and how measured.
        speed: of one face in a large batch.
        terms: of its training pictures.
    """

    summary: str
    accuracy: str
    speed: str
    terms: str


def read_cards() -> dict[str, Card]:
    """The cards of all bundled models, by name."""
    text = resources.files(__package__).joinpath("bundled", _CARDS).read_text(encoding="utf-8")
    return {name: Card(**card) for name, card in json.loads(text).items()}
