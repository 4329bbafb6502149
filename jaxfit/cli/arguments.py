"""Arguments that several commands share, and how their values are read."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxfit.data.boxes import read_boxes
from jaxfit.data.datasets import FORMATS, read_dataset
from jaxfit.data.records import Dataset
from jaxfit.descriptors.sift import Sift
from jaxfit.exceptions import InputError
from jaxfit.image.frame import Frame
from jaxfit.models.model import SQUARE, Model
from jaxfit.shapes.schemes import Scheme
from jaxfit.training import METHODS, Options

_DEFAULT = Options()


def add_datasets(command: argparse.ArgumentParser) -> None:
    """``--data SPEC...``."""
    command.add_argument(
        "--data",
        nargs="+",
        required=True,
        metavar="SPEC",
        help=f"datasets as FORMAT:PATH, with FORMAT one of {', '.join(FORMATS)}",
    )


def add_boxes(command: argparse.ArgumentParser, otherwise: str) -> None:
    """``--boxes FILE.csv`` and ``--box-kind KIND``."""
    command.add_argument(
        "--boxes",
        metavar="FILE.csv",
        help=f"face boxes with the columns image,x,y,width,height (image is the file's name); without it, {otherwise}",
    )
    command.add_argument(
        "--box-kind",
        default=SQUARE,
        metavar="KIND",
        help="what drew the boxes of FILE.csv: square (around the landmarks, the default), haar-frontal, haar-profile",
    )


def given_boxes(arguments: argparse.Namespace, model: Model) -> dict[str, list[np.ndarray]] | None:
    """The boxes that ``--boxes`` names, by picture; None without it.

    Raises:
        InputError: the file is wrong, the model does not know the kind of box, or there is a kind but no file.
    """
    if arguments.boxes is None:
        if arguments.box_kind != SQUARE:
            raise InputError(f"--box-kind {arguments.box_kind} says what drew the boxes of --boxes; give that file too")
        return None
    model.placement(arguments.box_kind)
    return read_boxes(arguments.boxes)


def add_training(command: argparse.ArgumentParser) -> None:
    """``--method`` and the options of training."""
    command.add_argument("--method", choices=sorted(METHODS), default="sdm", help="what to train")
    command.add_argument(
        "--windows",
        type=float,
        nargs="+",
        default=list(_DEFAULT.windows),
        metavar="SHARE",
        help="side of the descriptor window as a share of the face's side, one number a step; "
        "the thesis's constant is 32 / FACE for every step",
    )
    command.add_argument("--augmentations", type=int, default=_DEFAULT.augmentations, help="starts drawn a face")
    command.add_argument("--variance", type=float, default=_DEFAULT.variance, help="share kept by the features' PCA")
    command.add_argument("--ridge", type=float, default=_DEFAULT.ridge, help="ridge strength; 0 is least squares")
    command.add_argument("--spread", type=float, default=_DEFAULT.spread, help="factor on the spread of the starts")
    command.add_argument("--no-mirror", action="store_true", help="do not train on mirrored pictures too")
    command.add_argument("--no-haar", action="store_true", help="do not learn how Haar boxes lie; saves minutes")
    command.add_argument(
        "--orientation", choices=("upright", "principal"), default=Sift().orientation, help="of windows"
    )
    command.add_argument(
        "--normalisation", choices=("cell", "vector"), default=Sift().normalisation, help="of descriptors"
    )
    command.add_argument("--crop", type=int, default=Frame().crop, help="side of the crops, in pixels")
    command.add_argument("--face", type=float, default=Frame().face, help="side of the face in them, in pixels")
    command.add_argument("--seed", type=seed, default=_DEFAULT.seed, help="same seed, machine and cores: same model")


def training_options(arguments: argparse.Namespace, scheme: Scheme) -> Options:
    """The options of training that the command line gives; faces of unknown landmarks are not mirrored."""
    return Options(
        windows=tuple(arguments.windows),
        augmentations=arguments.augmentations,
        variance=arguments.variance,
        ridge=arguments.ridge,
        spread=arguments.spread,
        mirror=not arguments.no_mirror and scheme.mirror is not None,
        haar=not arguments.no_haar,
        seed=arguments.seed,
        descriptor=Sift(arguments.orientation, arguments.normalisation),
        frame=Frame(arguments.crop, arguments.face),
    )


def seed(text: str) -> int:
    """A seed on the command line: a whole number that is not negative."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"expected a seed of 0 or more; got {text}")
    return number


def read_datasets(specs: Sequence[str]) -> list[Dataset]:
    """The datasets that ``--data`` names.

    Raises:
        InputError: one is named twice.
        DatasetError: one cannot be read.
    """
    if len(set(specs)) < len(specs):
        raise InputError(f"--data: expected each dataset once; got {' '.join(specs)}")
    return [read_dataset(spec) for spec in specs]


def out_folder(path: str) -> Path:
    """The folder to write to, made if needed.

    Raises:
        InputError: it is a file, or cannot be made.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out: expected a folder to write to; {folder}: {error.strerror}") from None
    return folder
