"""Teach a model a kind of box: how faces lie in a dataset's own boxes, measured on the pictures that are frontal."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import jaxfit
from jaxfit.cli.main import exit_code
from jaxfit.cli.progress import Bars, report_problems
from jaxfit.labels.datasets import parse_spec, read_datasets
from jaxfit.learning.placements import calibrate_boxes, frontal
from jaxfit.models.files import check_target


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", metavar="MODEL", help="a model that was trained with the Haar detectors")
    parser.add_argument("--data", required=True, metavar="SPEC", help="a dataset with boxes; its format names the kind")
    parser.add_argument("--out", required=True, metavar="MODEL.safetensors", help="the model file to write")
    return exit_code(run, parser.parse_args())


def run(arguments: argparse.Namespace) -> int:
    check_target(Path(arguments.out))
    model = jaxfit.load(arguments.model)
    (dataset,) = read_datasets([arguments.data], None)
    with Bars() as bars:
        calibrated = calibrate_boxes(model, [face for face in dataset.faces if frontal(face)], progress=bars)
    placement = calibrated.placement
    report_problems([*dataset.problems, *calibrated.problems])
    kind = parse_spec(dataset.spec)[0]
    jaxfit.save(replace(model, placements={**model.placements, kind: placement}), arguments.out)
    lies = f"shift {placement.shift}, log scale {placement.log_scale:.3f}"
    print(f"{arguments.out}: knows {kind} boxes, measured on {calibrated.faces} faces: {lies}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
