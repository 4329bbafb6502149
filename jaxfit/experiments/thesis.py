"""The thesis's own numbers: Tables 3 to 7 and Appendices A to E, to stand beside what is measured."""

import json
from importlib.resources import files
from typing import Any

# "errors" and "pose" are means and half-widths of 95 % confidence intervals, "selected" augmentations and steps, "grid"
# by steps (rows) and augmentations, "starts" by initialisations, "pose_grid" by pitch (rows; the true tilts of
# Pointing'04, which the appendices print multiplied by 0.75) and yaw.
THESIS: dict[str, Any] = json.loads((files("jaxfit.experiments") / "thesis.json").read_text(encoding="utf-8"))
