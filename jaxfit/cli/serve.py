"""``jaxfit serve``: a page in the browser that fits pictures and webcams."""

import argparse
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from jaxfit.cli.arguments import add_heads, add_unshift
from jaxfit.cli.progress import say, warn
from jaxfit.data.detectors import DETECTORS, detector_named, detector_specs
from jaxfit.errors import InputError
from jaxfit.fitting.pipeline import usual_detector
from jaxfit.heads.with_heads import ensure_heads
from jaxfit.models.files import DEFAULT_MODEL, bundled, load
from jaxfit.serving import Server, Service

T = TypeVar("T")


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "serve",
        help="open a page that fits pictures and webcams",
        description="Serve a page to the browsers of this machine, until Ctrl-C. It fits pictures that are "
        "dropped on it, or those of a webcam, and draws landmarks and heads. Pictures stay in "
        "memory; nothing is written or sent anywhere.",
    )
    command.add_argument(
        "--model",
        nargs="+",
        metavar="MODEL",
        help="bundled models' names or model files to choose from (default: all bundled models)",
    )
    command.add_argument(
        "--detector",
        nargs="+",
        metavar="SPEC",
        help=f"detectors to choose from: {', '.join(detector_specs())} (default: all that are installed)",
    )
    add_unshift(command)
    add_heads(command)
    command.add_argument("--port", type=int, default=0, help="port to listen on (default: 0, any free one)")
    command.add_argument("--no-browser", action="store_true", help="only say where the page is")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    models = options.model or sorted(bundled(), key=lambda name: name != DEFAULT_MODEL)
    loaded = _by_name(models, load, _model_name)
    if options.heads:
        loaded = {name: ensure_heads(model) for name, model in loaded.items()}
    usual = usual_detector(next(iter(loaded.values())))  # what the page begins with suits the first model
    installed = (name for name, entry in DETECTORS.items() if entry.installed)
    detectors = options.detector or sorted(installed, key=lambda name: name != usual)
    if options.unshift:
        still = [name for name, model in loaded.items() if not model.cascade.frame.shift]
        if still:
            warn([f"--unshift changes nothing for {', '.join(still)}: no shift of their labels is known"])
        loaded = {name: model.unshifted() for name, model in loaded.items()}
    service = Service(loaded, _by_name(detectors, detector_named, _detector_name))
    with Server(service, options.port) as server:
        try:
            say(f"jaxfit is at {server.address} (Ctrl-C ends it)", flush=True)
            service.warm_up()
            if not options.no_browser:
                webbrowser.open(server.address)
            server.serve_forever()
        except KeyboardInterrupt:
            say("\nstopped", flush=True)
        finally:
            service.close()
    return 0


def _model_name(spec: str) -> str:
    return Path(spec).stem


def _detector_name(spec: str) -> str:
    return spec.partition(":")[0]


def _by_name(specs: Sequence[str], make: Callable[[str], T], name: Callable[[str], str]) -> dict[str, T]:
    """What the specifications stand for, by the names that the page shows.

    Raises:
        InputError: two have the same name.
    """
    names = list(map(name, specs))
    if len(set(names)) < len(names):
        raise InputError(f"expected each name once; got {' '.join(names)}")
    return {name: make(spec) for name, spec in zip(names, specs, strict=True)}
