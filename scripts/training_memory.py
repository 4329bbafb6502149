"""Peak memory and time of ``jaxfit train`` against the number of augmentations, one process each, as a table.

Options that are not this script's own go to ``jaxfit train``.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from jaxfit.cli.arguments import add_datasets
from jaxfit.evaluation.tables import markdown_table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_datasets(parser)
    parser.add_argument("--augmentations", type=int, nargs="+", default=[5, 10, 20, 40])
    arguments, others = parser.parse_known_args()
    others += ["--scheme", arguments.scheme] if arguments.scheme else []
    rows = [measure(arguments.data, count, others) for count in arguments.augmentations]
    least = min(row["peak MiB"] for row in rows)
    for row in rows:
        row["against the least"] = row["peak MiB"] / least - 1
    print(
        markdown_table(rows, {"augmentations": "d", "peak MiB": ".0f", "against the least": "+.1%", "minutes": ".1f"})
    )


def measure(data: list[str], augmentations: int, others: list[str]) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "jaxfit.cli.main", "train", "--data", *data, "--no-haar"]
        command += ["--augmentations", str(augmentations), "--out", str(Path(folder) / "model.safetensors"), *others]
        begin = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        if status != 0:
            raise SystemExit(f"failed: {' '.join(command)}")
        minutes = (time.perf_counter() - begin) / 60
    return {"augmentations": augmentations, "peak MiB": usage.ru_maxrss / 1024, "minutes": minutes}


if __name__ == "__main__":
    main()
