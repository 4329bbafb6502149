"""Several runs into one folder, stopped and continued at random moments: one result, whole."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from csv_files import labelled_box, read_csv, write_boxes

from jaxfit.runs import FolderRun, fit_folder

# A run whose chunks take some time, and are many.
_SLOW = """
import sys, time
from jaxfit.errors import InputError
from jaxfit.runs import FolderRun, fit_folder, folder
from jaxfit.runs.run_folder import RunFolder

folder._CHUNK = 1
put = RunFolder.put

def late(self, number, rows):
    time.sleep(0.05)
    put(self, number, rows)

RunFolder.put = late
out, model, boxes, *pictures = sys.argv[1:]
print("begun", flush=True)
try:
    fit_folder(FolderRun(out, model, boxes=boxes, overlays=False), pictures)
    print("done")
except InputError as error:
    print(error)
"""


@pytest.mark.skipif(os.name != "posix", reason="stops processes")
def test_runs_into_one_folder_give_one_result(drawn: Path, drawn_model: Path, tmp_path: Path) -> None:
    pictures = [tmp_path / f"{number:02}.png" for number in range(12)]
    for path in pictures:
        path.write_bytes((drawn / "face000.png").read_bytes())
    boxes = write_boxes(tmp_path / "boxes.csv", {path.name: labelled_box(drawn / "face000.png") for path in pictures})
    out, chance = tmp_path / "out", random.Random(5)
    command = [sys.executable, "-c", _SLOW, *map(str, [out, drawn_model, boxes, *pictures])]
    runs = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    while any(run.poll() is None for run in runs):
        run = chance.choice(runs)
        if run.poll() is None:
            run.send_signal(signal.SIGSTOP)
            time.sleep(chance.random() / 4)
            run.send_signal(signal.SIGCONT)
            time.sleep(chance.random() / 4)  # the last one that is left has to run now and then
    said = [run.communicate() for run in runs]
    assert [run.returncode for run in runs] == [0, 0, 0], said
    for words, _ in said:
        assert words.split("\n")[1] == "done" or "is being written by `jaxfit fit`, process" in words, said
    assert any("done" in words for words, _ in said)
    whole = FolderRun(tmp_path / "whole", drawn_model, boxes=boxes, overlays=False)
    fit_folder(whole, pictures)
    assert read_csv(out / "landmarks.csv") == read_csv(tmp_path / "whole" / "landmarks.csv")
    assert sorted(path.name for path in out.iterdir()) == sorted(path.name for path in (tmp_path / "whole").iterdir())
