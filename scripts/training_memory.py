"""Peak memory and time of ``jaxfit train`` against the number of augmentations, one process each, as a table."""

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
    parser = argparse.ArgumentParser(description=__doc__)
    add_datasets(parser)
    parser.add_argument("--augmentations", type=int, nargs="+", default=[5, 10, 20])
    parser.add_argument("--windows", nargs="+", default=["0.45", "0.2"])
    arguments = parser.parse_args()
    rows = [measure(arguments, count) for count in arguments.augmentations]
    least = min(row["peak MiB"] for row in rows)
    for row in rows:
        row["against the least"] = row["peak MiB"] / least - 1
    print(
        markdown_table(rows, {"augmentations": "d", "peak MiB": ".0f", "against the least": "+.1%", "minutes": ".1f"})
    )


def measure(arguments: argparse.Namespace, augmentations: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "jaxfit.cli.main", "train", "--data", *arguments.data]
        command += ["--windows", *arguments.windows, "--augmentations", str(augmentations), "--no-haar"]
        command += ["--out", str(Path(folder) / "model.safetensors")]
        begin = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        if status != 0:
            raise SystemExit(f"failed: {' '.join(command)}")
        minutes = (time.perf_counter() - begin) / 60
    return {"augmentations": augmentations, "peak MiB": usage.ru_maxrss / 1024, "minutes": minutes}


if __name__ == "__main__":
    main()
