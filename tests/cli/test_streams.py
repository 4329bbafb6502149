"""Standard streams that are closed, full, or read by nobody: results are written all the same."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

# How the command is run, its exit code, and what it says on standard error, if that is read.
STREAMS = {
    "closed errors": ("{} 2>&-", 0, ""),
    "closed output": ("{} >&-", 0, ""),
    "nothing open": ("{} <&- >&- 2>&-", 0, ""),
    "a reader of one line": ("{} 2>&1 | head -1", 0, ""),
    "a full disk": ("{} >/dev/full", 2, "standard output: No space left on device"),
}


@pytest.mark.parametrize("case", STREAMS)
def test_results_are_written_whoever_reads_what_is_printed(
    case: str, drawn: Path, drawn_model: Path, tmp_path: Path
) -> None:
    form, code, says = STREAMS[case]
    boxes = tmp_path / "boxes.csv"
    boxes.write_text("image,x,y,width,height\nface000.png,36,41,48,48\n")
    pictures = [drawn / "face000.png", drawn / "face001.png"]  # the second has no box, which is said
    command = [sys.executable, "-m", "jaxfit", "fit", *pictures, "--model", drawn_model, "--boxes", boxes]
    line = shlex.join(map(str, [*command, "--out", tmp_path / "out"]))
    ran = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {form.format(line)}"], capture_output=True, text=True, check=False
    )
    assert ran.returncode == code, ran.stderr
    assert "Traceback" not in ran.stderr + ran.stdout
    assert "Exception ignored" not in ran.stderr
    assert says in ran.stderr
    assert len((tmp_path / "out" / "landmarks.csv").read_text().splitlines()) == 2
    assert "face001.png" in (tmp_path / "out" / "problems.csv").read_text()
    assert "landmarks.csv" in json.loads((tmp_path / "out" / "manifest.json").read_text())["files"]


def test_a_reader_who_has_seen_enough_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "jaxfit", "models"]
    listing = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (listing.returncode, listing.stderr) == (0, "")
