"""Build the bundled models from folders of data, by the commands that their cards show.

The data lie in one folder, as ``lfpw68``, ``helen68``, ``ytf68``, ``aflw``, ``aflw2000``, ``pointing04`` and ``ict``.
With ``--split`` (a folder of ``scripts/split.py``) the faces of LFPW, HELEN, YouTube Faces and AFLW are those of its
``train``, and what is built is measured on its ``test`` and on AFLW2000-3D: the figures of the cards.
"""

import argparse
import shlex
import subprocess
import sys
from pathlib import Path

from jaxfit.cli.arguments import out_folder
from jaxfit.cli.main import exit_code
from jaxfit.errors import InputError

SETS = ("lfpw68", "helen68", "ytf68")
SCRIPTS = Path(__file__).resolve().parent

# In commands, {faces} are the 68-point faces, {aflw} is AFLW's folder, {data} and {out} are the folders.
_WINDOWS = "--windows 0.45 0.36 0.28 0.22 0.18 0.15"
_DENSE = f"--descriptor dense {_WINDOWS} --no-detectors"
_ROOT = f"--descriptor dense --normalisation root {_WINDOWS} --no-detectors"
_WITHOUT = "--without aflw2000-all:{data}/aflw2000"
_LIFTED = f"--lift aflw+0.5:{{aflw}} {_WITHOUT}"
_SHARED = f"--share aflw+0.5:{{aflw}} {_WITHOUT}"
_RENDERED = [
    "scripts/render_poses.py --facekit {data}/ict/ict_facekit.npz --data {faces} --per-subject 4 --most 925 --seed 0 "
    "--out {out}/rendered",
    "scripts/render_poses.py --facekit {data}/ict/ict_facekit.npz --data {faces} --per-subject 2 --most 400 "
    "--turn tilt --seed 1 --out {out}/tilted",
]
_WIDE = (
    "jaxfit train --data {faces} pts:{out}/rendered pts:{out}/tilted --lift aflw:{aflw} --lift-yaw 30 "
    "--without aflw2000-all:{data}/aflw2000 --augmentations 3 --windows 0.5 0.4 0.31 0.24 0.19 0.15"
)


def limited(name: str, rank: int) -> str:
    """What makes a model's file smaller."""
    full, smaller = f"{{out}}/{name}.full.safetensors", f"{{out}}/{name}.safetensors"
    return f"scripts/limit_rank.py {full} {smaller} --data {{faces}} --rank {rank}"


RECIPES: dict[str, list[str]] = {
    "face68": [
        f"jaxfit train --data {{faces}} {_LIFTED} --lift-yaw 60 --shift 1 {_ROOT} --crop 148 --face 84 --rank 40 "
        "--out {out}/face68.greedy.safetensors",
        f"jaxfit finetune {{out}}/face68.greedy.safetensors --data {{faces}} {_SHARED} --epochs 10 --validation 0 "
        "--units 64 --guessed 0.3 --balance 0.5 --covered 0.2 --dark 0.1 --coarse 0.2 --compressed 0.15 "
        "--confidence 2 --out {out}/face68.safetensors",
    ],
    "face21": [
        f"jaxfit train --data aflw:{{aflw}} --fill {_WITHOUT} --shift 0.5 {_ROOT} --rank 24 "
        "--out {out}/face21.greedy.safetensors",
        f"jaxfit finetune {{out}}/face21.greedy.safetensors --data aflw:{{aflw}} --fill {_WITHOUT} --epochs 12 "
        "--validation 0 --confidence 2 --out {out}/face21.safetensors",
    ],
    "fast68": [
        f"jaxfit train --data {{faces}} --shift 1 {_DENSE} --rank 32 --out {{out}}/fast68.greedy.safetensors",
        f"jaxfit finetune {{out}}/fast68.greedy.safetensors --data {{faces}} {_SHARED} "
        "--epochs 12 --validation 0 --out {out}/fast68.safetensors",
    ],
    "sdm68": ["jaxfit train --data {faces} --out {out}/sdm68.full.safetensors", limited("sdm68", 48)],
    "parametric68": [
        "jaxfit train --data {faces} --method parametric --starts 11 "
        "--windows 0.45 0.45 0.4 0.34 0.26 0.2 0.15 --out {out}/parametric68.full.safetensors",
        limited("parametric68", 32),
    ],
    "regression68-3d": [
        *_RENDERED,
        f"{_WIDE} --method regression3d --out {{out}}/regression68-3d.uncalibrated.safetensors",
        "scripts/calibrate.py {out}/regression68-3d.uncalibrated.safetensors --data pointing04:{data}/pointing04 "
        "--out {out}/regression68-3d.full.safetensors",
        limited("regression68-3d", 28),
    ],
    "alignment68-3d": [
        *_RENDERED,
        f"{_WIDE} --method alignment3d --shape-variance 0.998 --no-detectors "
        "--out {out}/alignment68-3d.full.safetensors",
        limited("alignment68-3d", 32),
    ],
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", metavar="MODEL", help=f"of {', '.join(RECIPES)} (default: all)")
    parser.add_argument("--data", required=True, metavar="DIR", help="where the data sets lie")
    parser.add_argument("--split", metavar="DIR", help="learn from its train, and measure on its test")
    parser.add_argument("--out", required=True, metavar="DIR", help="where model files go")
    parser.add_argument("--dry-run", action="store_true", help="say the commands and run none")
    return exit_code(run, parser.parse_args())


def run(arguments: argparse.Namespace) -> int:
    names = list(dict.fromkeys(arguments.models or RECIPES))
    if unknown := set(names) - set(RECIPES):
        raise InputError(f"expected models among {', '.join(RECIPES)}; got {', '.join(sorted(unknown))}")
    folder = Path(arguments.out) if arguments.dry_run else out_folder(arguments.out)
    done: set[str] = set()
    for name in names:
        for command in commands_of(name, arguments, folder):
            if command not in done:  # rendered faces serve two models
                print(f"$ {command}", flush=True)
                done.add(command)
                if not arguments.dry_run and (code := subprocess.run(words_of(command), check=False).returncode):
                    return code
    return 0


def commands_of(name: str, arguments: argparse.Namespace, out: Path) -> list[str]:
    """What builds a model, and measures it if people were kept aside."""
    data, split, folder = shlex.quote(arguments.data), shlex.quote(arguments.split or ""), shlex.quote(str(out))
    of_faces = f"{split}/train" if arguments.split else data
    places = {"data": data, "out": folder, "faces": " ".join(f"pts:{of_faces}/{each}" for each in SETS)}
    places["aflw"] = f"{of_faces}/aflw"
    commands = [command.format(**places) for command in RECIPES[name]]
    if arguments.split:
        tested = " ".join(f"pts:{split}/test/{each}" for each in SETS)
        model = f"{folder}/{name}.safetensors"
        commands.append(f"jaxfit evaluate {model} --data {tested} --out {folder}/{name}")
        commands.append(
            f"jaxfit evaluate {model} --data aflw2000:{data}/aflw2000 --normaliser box --out {folder}/{name}-turned"
        )
    return commands


def words_of(command: str) -> list[str]:
    """The command as this Python runs it."""
    program, *rest = shlex.split(command)
    if program == "jaxfit":
        return [sys.executable, "-m", "jaxfit", *rest]
    return [sys.executable, str(SCRIPTS / Path(program).name), *rest]


if __name__ == "__main__":
    sys.exit(main())
