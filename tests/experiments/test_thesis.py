"""The thesis's numbers are those that it prints."""

import re
from pathlib import Path

import numpy as np
import pytest

from jaxfit.experiments.thesis.numbers import THESIS

METHODS = ["sdm", "parametric", "alignment3d", "regression3d"]


def test_tables_have_their_shapes() -> None:
    for dataset in ("AFLW", "LFPW"):
        for method in METHODS:
            for values in THESIS["grid"][dataset][method].values():
                assert np.shape(values) == (7, 6)
            assert len(THESIS["starts"][dataset][method]["mean"]) == 6
    for method in METHODS[2:]:
        for angle in ("pitch", "yaw"):
            known = np.array(THESIS["pose_grid"][method][angle], float)
            assert known.shape == (9, 13)
            # Straight up and down there is only the frontal picture.
            assert np.isfinite(known).sum() == 7 * 13 + 2


def test_what_its_text_says_of_the_grid() -> None:
    # 5.1: the best values of SDM on AFLW are found at 6 steps and 25 augmentations, of 3D regression at 15, 5.
    sdm = np.array(THESIS["grid"]["AFLW"]["sdm"]["mean"])
    assert np.unravel_index(sdm.argmin(), sdm.shape) == (5, 5)
    regression = np.array(THESIS["grid"]["AFLW"]["regression3d"]["mean"])
    assert np.unravel_index(regression.argmin(), regression.shape) == (4, 3)
    # Appendix C's first row is Tables 3 and 5.
    for dataset in ("AFLW", "LFPW"):
        for method in METHODS:
            assert THESIS["starts"][dataset][method]["mean"][0] == pytest.approx(
                THESIS["errors"][dataset][method][0], abs=2e-4
            )


def test_every_number_of_the_grid_stands_in_its_text() -> None:
    path = Path(__file__).resolve().parents[3] / "shared" / "paper" / "thesis.txt"
    if not path.is_file():
        pytest.skip("needs the text of the thesis in ../shared/paper")
    printed = set(re.findall(r"(\d\.\d{4})± (\d\.\d{4})", path.read_text(encoding="utf-8")))
    for dataset in THESIS["grid"].values():
        for values in dataset.values():
            for pair in zip(np.ravel(values["mean"]), np.ravel(values["ci95"]), strict=True):
                assert tuple(f"{number:.4f}" for number in pair) in printed
