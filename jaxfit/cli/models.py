"""``jaxfit models``: what models there are, and what is in a model file."""

import argparse
from importlib import resources
from pathlib import Path

from jaxfit.cli.progress import say
from jaxfit.models.cards import read_cards
from jaxfit.models.files import DEFAULT_MODEL, SUFFIX, load


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "models",
        help="list the models of the package",
        description="List the models of the package, or describe those that are named, and model files of your own.",
    )
    command.add_argument("names", nargs="*", metavar="MODEL", help="bundled models, or model files")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """List, or describe."""
    cards = read_cards()
    if options.names:
        say("\n\n".join(_described(name) for name in options.names))
        return 0
    width = max(map(len, cards))
    for name in sorted(cards, key=lambda name: name != DEFAULT_MODEL):
        default = " (the default)" if name == DEFAULT_MODEL else ""
        say(f"{name:{width}}  {_megabytes(name):4.1f} MB  {cards[name].summary}{default}")
    say("\n`jaxfit models NAME` says more. All were trained on pictures that are for research use.")
    return 0


def _described(name: str) -> str:
    card, model = read_cards().get(name), load(name)
    parts = {
        "for": card.summary if card else "",
        "landmarks": f"{model.scheme.count} ({model.scheme.name}){', 3D shape and pose' if model.space_3d else ''}",
        "method": f"{model.training.get('method', 'an unknown method')}, {len(model.cascade.weights)} steps",
        "confidence": "no" if model.confidence is None else "yes",
        "uncertainty": "no" if model.uncertainty is None else "yes",
        "boxes": ", ".join(model.known_placements),
        "trained on": f"{model.training.get('faces', 'an unknown number of')} faces",
        "accuracy": card.accuracy if card else "",
        "speed": card.speed if card else "",
        "size": f"{_megabytes(name):.1f} MB" if card else f"{Path(name).stat().st_size / 1e6:.1f} MB",
        "terms": card.terms if card else "",
    }
    width = max(map(len, parts))
    return "\n".join([name, *(f"  {key:{width}}  {value}" for key, value in parts.items() if value)])


def _megabytes(name: str) -> float:
    with resources.as_file(resources.files("jaxfit.models").joinpath("bundled", name + SUFFIX)) as path:
        return path.stat().st_size / 1e6
