"""The numbers of the thesis that jaxfit implements: Tables 3 to 7 and Appendices A to E, beside what is measured."""

import json
from importlib.resources import files
from typing import Any

# "errors" and "pose" are means and half-widths of 95 % confidence intervals, "selected" augmentations and steps, "grid"
# by steps (rows) and augmentations, "starts" by initialisations, "pose_grid" by pitch (rows; the true tilts of
# Pointing'04, which the appendices print multiplied by 0.75) and yaw.
THESIS: dict[str, Any] = json.loads((files("jaxfit.experiments") / "thesis.json").read_text(encoding="utf-8"))

# Its figures, for 2D and 3D methods.
_FIGURES = {
    ("grid", "AFLW"): ("Figure 12", "Figure 15"),
    ("grid", "LFPW"): ("Figure 13", "Figure 16"),
    ("starts", "AFLW"): ("Figure 14a", "Figure 17a"),
    ("starts", "LFPW"): ("Figure 14b", "Figure 17b"),
    ("ced", "AFLW"): ("Figure 18a", "Figure 19a"),
    ("ced", "LFPW"): ("Figure 18b", "Figure 19b"),
    ("fits", "AFLW"): ("Figure 22a", "Figure 23a"),
    ("fits", "LFPW"): ("Figure 22b", "Figure 23b"),
}


def numbered(what: str, dataset: str | None, in_3d: bool, title: str) -> str:
    """A title, with the number of the thesis's figure of the same if the dataset has a counterpart there."""
    figures = _FIGURES.get((what, dataset or ""))
    return f"{figures[in_3d]}. {title}" if figures else title


def of_thesis(part: str, dataset: str | None, method: str) -> Any:
    """What a part of its numbers says of a method on a dataset; None if nothing."""
    return THESIS[part].get(dataset or "", {}).get(method)
