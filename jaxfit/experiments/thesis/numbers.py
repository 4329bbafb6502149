"""The numbers of the thesis that jaxfit implements: its Tables 3 to 7 and Appendices A to E."""

import json
from importlib.resources import files
from typing import Any

# "errors" and "pose" are means and half-widths of 95 % confidence intervals, "selected" augmentations and steps, "grid"
# by steps (rows) and augmentations, "starts" by initialisations, "pose_grid" by pitch (rows; the true tilts of
# Pointing'04, which the appendices print multiplied by 0.75) and yaw.
THESIS: dict[str, Any] = json.loads((files("jaxfit.experiments.thesis") / "thesis.json").read_text(encoding="utf-8"))
# What a dataset can be compared with.
THESIS_DATASETS = tuple(THESIS["errors"])


def thesis_value(part: str, dataset: str | None, method: str) -> Any:
    """What a part of the numbers has for a method on one of the thesis's datasets; None if nothing."""
    return THESIS[part].get(dataset or "", {}).get(method)
