"""``jaxfit doctor``: what is installed, and whether it works."""

import argparse
import os
import platform
import time
from collections.abc import Iterator
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import jaxfit
from jaxfit.cli.progress import say
from jaxfit.data.detectors import DETECTORS
from jaxfit.data.samples import sample
from jaxfit.schemes.known import IBUG68

_PACKAGES = ("jax", "jaxlib", "numpy", "opencv-python-headless", "optax", "safetensors", "scipy")
# A module of each extra that adds something to a command.
_EXTRAS = {
    "plots": "matplotlib",
    "experiments": "jinja2",
    "export": "flatbuffers",
    "parquet": "pyarrow",
    "ray": "ray",
    "dlib": "dlib",
    "heif": "pillow_heif",
    "completion": "shtab",
}
# Pixels of the sample portrait, where the picture shows these points of the 68: the outer corners of the eyes, the tip
# of the nose, the corners of the mouth, and the chin.
_PORTRAIT = {36: (214, 191), 45: (319, 188), 30: (268, 238), 48: (234, 281), 54: (306, 280), 8: (269, 329)}
_TOLERANCE = 0.15  # of the distance between the outer corners of the eyes


class Check(NamedTuple):
    """What was looked at, what was found, and whether that is as it should be; None where it need not be."""

    name: str
    found: str
    fine: bool | None = None


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "doctor",
        help="say what is installed, and whether it works",
        description="Say which versions, devices, detectors and extras there are, and fit a picture that comes with "
        "the package. Ends with 1 if something does not work.",
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Look at everything; 1 if something does not work."""
    fine = True
    for check in checks():
        mark = {True: "ok", False: "WRONG", None: ""}[check.fine]
        say(f"{check.name:24} {check.found}{f'  {mark}' if mark else ''}")
        fine = fine and check.fine is not False
    return 0 if fine else 1


def checks() -> Iterator[Check]:
    """All that the command looks at, one after the other."""
    yield Check("jaxfit", jaxfit.__version__)
    yield Check("Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}")
    for name in _PACKAGES:
        yield Check(name, _version(name))
    yield Check("devices", ", ".join(f"{device.platform} ({device.device_kind})" for device in jax.devices()))
    yield Check("processors", f"{os.cpu_count()}")
    yield _cache()
    yield Check("detectors", ", ".join(name for name, entry in DETECTORS.items() if entry.installed))
    for extra, module in _EXTRAS.items():
        there = find_spec(module) is not None
        yield Check(f"jaxfit[{extra}]", "installed" if there else f'not installed: pip install "jaxfit[{extra}]"')
    yield _self_test()


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:  # OpenCV has several packages
        return "another package, or built from source"


def _cache() -> Check:
    """Where compiled code is kept: without it, each run compiles for some seconds."""
    folder = getattr(jax.config, "jax_compilation_cache_dir", None)
    if not folder:
        return Check("compiled code", "not kept: there is no folder for it that can be written", None)
    writable = "://" in folder or os.access(folder, os.W_OK)
    return Check("compiled code", f"{folder}{'' if writable else ', which cannot be written'}", writable)


def _self_test() -> Check:
    """The sample's landmarks, and how long they took."""
    begin = time.perf_counter()
    try:
        fits = jaxfit.fit(jaxfit.load(), [sample("portrait")])
    except Exception as error:  # whatever it is, it is what the user wants to know
        return Check("a fit", f"{type(error).__name__}: {error}", False)
    seconds = time.perf_counter() - begin
    if len(fits) != 1 or not fits.fitted.all():
        return Check("a fit", f"{len(fits)} faces found in {Path(sample('portrait')).name}, expected one", False)
    points = np.array(list(_PORTRAIT.values()), float)
    apart = np.linalg.norm(fits.landmarks[0, list(_PORTRAIT)] - points, axis=1).max()
    share = apart / np.linalg.norm(points[1] - points[0])
    fine = bool(share <= _TOLERANCE)
    where = (
        "where the portrait has them" if fine else f"up to {share:.0%} of the eyes' distance from where they should be"
    )
    return Check("a fit", f"{IBUG68.count} landmarks in {seconds:.1f} s, {where}", fine)
