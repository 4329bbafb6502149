"""What held when it was attacked, and must keep holding: few descriptors, several threads, many requests."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from csv_files import labelled_box, read_csv, write_boxes

import jaxfit
from jaxfit.data.pictures import read_image

_FEW = """
import resource, sys
from jaxfit.runs import FolderRun, fit_folder, folder
folder._CHUNK = 32
out, model, boxes, *pictures = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
print(fit_folder(FolderRun(out, model, boxes=boxes), pictures).faces)
"""


@pytest.mark.skipif(os.name != "posix", reason="limits are POSIX's")
def test_64_descriptors_are_enough(drawn: Path, drawn_model: Path, tmp_path: Path) -> None:
    pictures = [tmp_path / f"{number:03}.png" for number in range(100)]
    for path in pictures:
        os.link(drawn / "face000.png", path)
    boxes = write_boxes(tmp_path / "boxes.csv", {path.name: labelled_box(drawn / "face000.png") for path in pictures})
    command = [sys.executable, "-c", _FEW, *map(str, [tmp_path / "out", drawn_model, boxes, *pictures])]
    said = subprocess.run(command, capture_output=True, text=True, check=False)
    assert said.stdout.strip() == "100", said.stderr
    assert len(read_csv(tmp_path / "out" / "landmarks.csv")) == 100


def test_eight_threads_find_what_one_finds(drawn: Path, drawn_model: Path) -> None:
    model = jaxfit.load(drawn_model)
    pictures = [read_image(drawn / f"face{number:03}.png") for number in range(4)]
    boxes = [labelled_box(drawn / f"face{number:03}.png") for number in range(4)]
    alone = jaxfit.fit(model, pictures, boxes).landmarks
    end = time.monotonic() + 3

    def fit(_: int) -> int:
        count = 0
        while time.monotonic() < end:
            np.testing.assert_allclose(jaxfit.fit(model, pictures, boxes).landmarks, alone, atol=1e-3)
            count += 1
        return count

    with ThreadPoolExecutor(8) as pool:
        assert min(pool.map(fit, range(8))) >= 1
