"""``jaxfit export``: write a model as programs that need JAX alone."""

import argparse
from pathlib import Path

from jaxfit.cli.arguments import add_heads, add_starts, add_unshift, given_starts, given_unshift, untrained_starts
from jaxfit.cli.progress import say, warn
from jaxfit.data.inputs import require_no_inputs
from jaxfit.fitting.export import export_model, load_exported
from jaxfit.heads.with_heads import ensure_heads
from jaxfit.models.files import SUFFIX, load


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "export",
        help="write a model as programs that need JAX alone",
        description="Write a model as one file of programs, from crops to landmarks, for use without jaxfit. "
        "Needs jaxfit[export].",
    )
    command.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file")
    command.add_argument("--out", required=True, metavar=f"FILE{SUFFIX}", help="the file to write")
    add_starts(command, "starts a face; several, for models trained for it, find turned faces")
    add_unshift(command)
    add_heads(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Export, and load again what was written."""
    model, out = load(options.model), Path(options.out)
    starts = given_starts(options)
    require_no_inputs([out], [options.model])
    warn(untrained_starts(options.model, model.starts, starts) + given_unshift(options, model.cascade.frame))
    model = model.unshifted() if options.unshift else model
    export_model(ensure_heads(model) if options.heads else model, out, starts)
    exported = load_exported(out)
    side = exported.frame.crop
    say(f"{out}: {options.model}, {model.scheme.name}, {out.stat().st_size / 2**20:.1f} MiB")
    say(f"in: crops (N, {side}, {side}) uint8")
    for name, output in exported.outputs.items():
        say(f"out: {name} ({', '.join(map(str, output['shape']))}) {output['dtype']}: {output['unit']}")
    return 0
