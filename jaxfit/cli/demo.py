"""``jaxfit demo``: fit the picture that comes with the package, in any folder."""

import argparse
from pathlib import Path

from jaxfit.cli import fit
from jaxfit.cli.progress import say
from jaxfit.data.samples import sample


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "demo",
        help="try it on a picture that comes with the package",
        description="Fit the face in a picture that comes with the package, as `jaxfit fit` does.",
    )
    command.add_argument("--out", default="demo", metavar="DIR", help="where the results go (default: demo)")

    def run(options: argparse.Namespace) -> int:
        """Fit, and say where to look."""
        words = [str(sample("portrait")), "--heads", "--out", options.out]
        say(f"$ jaxfit fit {' '.join(words)}")
        code = fit.run(commands.choices["fit"].parse_args(words))
        if code == 0:
            say(f"Look at {Path(options.out) / 'overlays' / 'portrait.jpg'}")
        return code

    command.set_defaults(run=run)
