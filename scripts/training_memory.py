"""Peak memory and time of ``jaxfit train`` against the number of augmentations, one process each.

Options that are not this script's own go to ``jaxfit train``.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from report import Report, measure, script_parser
from train_processes import all_ended, started

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
        command = ["train", "--no-detectors", *options, "--augmentations", str(augmentations)]
        command += ["--out", str(Path(folder) / "model.safetensors")]
        (ended,) = all_ended(started(command, 1, Path(folder)), require=0)
    return {"augmentations": augmentations, "peak MiB": ended.peak, "minutes": ended.seconds / 60}


if __name__ == "__main__":
    sys.exit(main())
