"""The formats of labelled faces by the names that the command line uses: ``FORMAT:PATH``."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from jaxfit.data.aflw import read_aflw
from jaxfit.data.lfpw import read_lfpw
from jaxfit.data.pts import read_pts_folder
from jaxfit.data.records import Dataset
from jaxfit.exceptions import InputError

# A reader gets the path and returns the labelled faces, at least one of them with its picture, or raises DatasetError.
FORMATS: dict[str, Callable[[Path], Dataset]] = {
    "pts": read_pts_folder,
    "pts0": partial(read_pts_folder, base=0),
    "aflw": read_aflw,
    "lfpw": read_lfpw,
}


def read_dataset(spec: str) -> Dataset:
    """The dataset that ``spec``, ``FORMAT:PATH``, names.

    Raises:
        InputError: no path, or an unknown format.
        DatasetError: the dataset is missing, damaged, or has no face that can be used.
    """
    name, _, path = spec.partition(":")
    if name not in FORMATS or not path:
        raise InputError(f"expected a dataset as FORMAT:PATH with FORMAT one of {', '.join(FORMATS)}; got {spec!r}")
    return replace(FORMATS[name](Path(path)), spec=spec)
