"""Small files that stand for large pictures: what decoding them costs, in seconds and memory, in all formats.

Each is decoded in a process of its own: black pictures of the largest size that is read, and of one that is refused.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from report import Report, measure, script_parser

_FORMATS = (".jpg", ".png", ".webp", ".bmp", ".tiff", ".gif", ".avif", ".jp2", ".pgm")
_SIDES = {".webp": 16_383, ".gif": 65_535, ".avif": 16_384}  # the largest of the formats
_DECODE = """
import resource, sys, time
from jaxfit.data.pictures import read_image
from jaxfit.errors import ImageError
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
begun = time.perf_counter()
try:
    outcome = "x".join(map(str, read_image(sys.argv[1]).shape[1::-1]))
except ImageError as error:
    outcome = "refused"
taken = time.perf_counter() - begun
print(outcome, taken, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("--megapixels", type=float, nargs="+", default=[170.0, 200.0], help="of the pictures")
    return measure(run, parser.parse_args())


def run(options: argparse.Namespace, report: Report) -> None:
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for suffix in _FORMATS:
            for megapixels in options.megapixels:
                side = min(int((megapixels * 1e6) ** 0.5), _SIDES.get(suffix, 65_535))
                path = Path(name) / f"bomb{suffix}"
                speed = [cv2.IMWRITE_AVIF_SPEED, 10] if suffix == ".avif" else []
                path.write_bytes(cv2.imencode(suffix, np.zeros((side, side), np.uint8), speed)[1].tobytes())
                said = subprocess.run([sys.executable, "-c", _DECODE, path], check=True, capture_output=True, text=True)
                outcome, seconds, memory = said.stdout.split()
                rows.append(
                    {
                        "format": suffix[1:],
                        "kB": path.stat().st_size / 1000,
                        "megapixels": side**2 / 1e6,
                        "outcome": outcome,
                        "seconds": float(seconds),
                        "MiB": float(memory),
                    }
                )
    report.table(rows, {"format": "", "kB": ".0f", "megapixels": ".0f", "outcome": "", "seconds": ".2f", "MiB": ".0f"})


if __name__ == "__main__":
    sys.exit(main())
