"""Build both packages, and try the wheel as someone new would, on each Python that is named: `pip install` into an
empty environment, `jaxfit doctor`, and `jaxfit demo` with nothing compiled yet and once more.

The wheel is built from the source distribution. pip keeps no cache, but the machine's settings for pip hold: where it
takes packages from, a registry or a mirror on disk, makes most of its seconds. Each Python gets the versions that pip
chooses.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from report import Report, measure, script_parser

import jaxfit
from jaxfit.cli.arguments import out_folder
from jaxfit.errors import InputError
from jaxfit.evaluation.tables import Row

ROOT = Path(__file__).resolve().parents[1]
TRIES = {
    "Python": "s",
    "pip install, s": ".0f",
    "first landmarks, s": ".1f",
    "again, s": ".1f",
    "download, MB": ".0f",
    "on disk, MB": ".0f",
}
SIZES = {"what": "s", "MB": ".1f"}
_MB = 1e6
_SHOWN = 8  # of the installed packages, the largest


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("--python", nargs="+", default=[sys.executable], metavar="PROGRAM", help="Pythons to try it on")
    parser.add_argument("--dist", default="dist", metavar="DIR", help="where the packages go (default: dist)")
    return measure(run, parser.parse_args())


def run(arguments: argparse.Namespace, report: Report) -> None:
    dist = out_folder(arguments.dist).resolve()
    ended("build", [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(dist), str(ROOT)], ROOT)
    (wheel,), (source,) = (list(dist.glob(f"jaxfit-{jaxfit.__version__}{end}")) for end in ("-*.whl", ".tar.gz"))
    rows: list[Row] = []
    sizes: dict[str, int] = {}
    for python in arguments.python:
        with tempfile.TemporaryDirectory() as folder:
            row, sizes = tried(python, wheel, Path(folder))
        rows.append(row)
    report.table(rows, TRIES)
    files = {"wheel": wheel.stat().st_size, "source distribution": source.stat().st_size}
    largest = sorted(sizes.items(), key=lambda item: -item[1])[:_SHOWN]
    installed = {f"installed: {name}": size for name, size in largest}
    installed["installed: all others"] = sum(sizes.values()) - sum(installed.values())
    report.table([{"what": what, "MB": size / _MB} for what, size in (files | installed).items()], SIZES)


def tried(python: str, wheel: Path, folder: Path) -> tuple[Row, dict[str, int]]:
    """The row of a Python, and the bytes of what was installed, by the names in ``site-packages``."""
    environment = folder / "environment"
    ended("venv", [python, "-m", "venv", str(environment)], folder)
    own = environment / "bin"
    (packages,) = environment.glob("lib/python*/site-packages")
    before = {path.name for path in packages.iterdir()}
    version = ended("version", [str(own / "python"), "--version"], folder)[1].split()[-1]
    pip = [str(own / "python"), "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-cache-dir"]
    installing = ended("pip install", [*pip, "install", str(wheel)], folder)[0]
    ended("pip download", [*pip, "download", "--dest", "downloads", str(wheel)], folder)
    first, again = (ended("demo", [str(own / "jaxfit"), "demo", "--out", out], folder)[0] for out in ("first", "again"))
    ended("doctor", [str(own / "jaxfit"), "doctor"], folder)
    sizes = {path.name: size_of(path) for path in packages.iterdir() if path.name not in before}
    row = {
        "Python": version,
        "pip install, s": installing,
        "first landmarks, s": first,
        "again, s": again,
        "download, MB": size_of(folder / "downloads") / _MB,
        "on disk, MB": sum(sizes.values()) / _MB,
    }
    return row, sizes


def ended(name: str, command: list[str], folder: Path) -> tuple[float, str]:
    """Run a command in a folder, as a user without settings or compiled code of jaxfit's: its seconds, what it printed.

    Raises:
        InputError: it failed.
    """
    settings = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "JAX", "XLA"))}
    settings["XDG_CACHE_HOME"] = str(folder / "cache")
    begin = time.perf_counter()
    done = subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True)
    if done.returncode:
        raise InputError(f"{name} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return time.perf_counter() - begin, done.stdout


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    return sum(file.stat().st_size for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file())


if __name__ == "__main__":
    sys.exit(main())
