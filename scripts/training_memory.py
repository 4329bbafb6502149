"""Peak memory and time of ``jaxfit train`` against the number of augmentations, one process each.

Options that are not this script's own go to ``jaxfit train``.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from report import Report, measure, script_parser

from jaxfit.errors import JaxfitError

COLUMNS = {"augmentations": "d", "peak MiB": ".0f", "against the least": "+.1%", "minutes": ".1f"}


def main() -> int:
    parser = script_parser(__doc__)
    parser.add_argument("--augmentations", type=int, nargs="+", default=[5, 10, 20, 40])
    arguments, others = parser.parse_known_args()
    arguments.train = others
    return measure(run, arguments)


def run(arguments: argparse.Namespace, report: Report) -> None:
    rows = [trained(count, arguments.train) for count in arguments.augmentations]
    least = min(row["peak MiB"] for row in rows)
    for row in rows:
        row["against the least"] = row["peak MiB"] / least - 1
    report.table(rows, COLUMNS)


def trained(augmentations: int, options: list[str]) -> dict[str, float]:
    """The row of a training."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "jaxfit", "train", "--no-haar", *options]
        command += ["--augmentations", str(augmentations), "--out", str(Path(folder) / "model.safetensors")]
        begin = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        if status != 0:
            raise JaxfitError(f"failed: {' '.join(command)}")
        minutes = (time.perf_counter() - begin) / 60
    return {"augmentations": augmentations, "peak MiB": usage.ru_maxrss / 1024, "minutes": minutes}


if __name__ == "__main__":
    sys.exit(main())
