"""Arguments that several commands share, and how their values are read."""

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxfit.cascade.greedy import Greedy
from jaxfit.cascade.starts import Starts
from jaxfit.data.cameras import Camera, FieldOfView, PinholeCamera
from jaxfit.data.detectors import Search, box_kinds, detector_specs
from jaxfit.data.limits import DEFAULT_MEGAPIXELS, MOST_SLOW_BYTES
from jaxfit.data.numbers import whole_number
from jaxfit.data.sizes import HEAVY
from jaxfit.descriptors import DESCRIPTORS, descriptor_like, kind_of
from jaxfit.descriptors.dense import ZOOMS
from jaxfit.descriptors.normalise import NORMALISATIONS
from jaxfit.descriptors.sift import ORIENTATIONS
from jaxfit.errors import InputError
from jaxfit.fitting.pipeline import Fitting
from jaxfit.fitting.place import PUPIL_DISTANCE, Placing
from jaxfit.image.frame import Frame
from jaxfit.labels.datasets import FORMATS
from jaxfit.learning.methods import Options, default_descriptor, options_for
from jaxfit.models.files import DEFAULT_MODEL, SUFFIX
from jaxfit.schemes.known import SCHEMES
from jaxfit.schemes.normalisers import NORMALISERS
from jaxfit.schemes.scheme import Scheme

_DEFAULT = Options()


class DefaultsInHelp(argparse.ArgumentDefaultsHelpFormatter):
    """Help with the defaults of options that have one, unless the help names it in its own words."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        plain = default is None or default is False or default == [] or "(default" in (action.help or "")
        return action.help if plain else super()._get_help_string(action)


def add_datasets(command: argparse.ArgumentParser) -> None:
    """``--data SPEC...`` and ``--scheme NAME``."""
    command.add_argument(
        "--data",
        nargs="+",
        required=True,
        metavar="SPEC",
        help=f"datasets as FORMAT:PATH, with FORMAT one of {', '.join(FORMATS)}; FORMAT+PIXELS:PATH moves the "
        "labels right and down by that many pixels; FORMAT@stored:PATH is for labels of the pixels as they "
        "are stored, before EXIF data turn the picture",
    )
    add_scheme(command)
    add_max_megapixels(command)


def add_scheme(command: argparse.ArgumentParser) -> None:
    """``--scheme NAME``."""
    command.add_argument(
        "--scheme",
        metavar="NAME",
        help=f"what the landmarks mean: converts the labels to {', '.join(SCHEMES)}, or to points<N>, N points "
        "that are only numbered; or a scheme of your own, as a TOML file or a table such as "
        "'{mirror = [[1, 4]], lines = [[1, 2]]}'",
    )


def add_max_megapixels(command: argparse.ArgumentParser) -> None:
    """``--max-megapixels N``."""
    command.add_argument(
        "--max-megapixels",
        type=float,
        default=DEFAULT_MEGAPIXELS,
        metavar="N",
        help=f"the largest picture that is read, in million pixels (default: {DEFAULT_MEGAPIXELS:g}); small "
        f"files can hold very large pictures. A pixel of AVIF, HEIC and Netpbm's floats counts as {HEAVY:g} "
        f"({DEFAULT_MEGAPIXELS / HEAVY:g} by default), one of JPEG 2000 with transparency as 1.33. Files of "
        f"AVIF, HEIC and JPEG 2000 may have at most {MOST_SLOW_BYTES // 1_000_000} MB, whatever N is",
    )


def add_pictures(command: argparse.ArgumentParser, what: str = "pictures") -> None:
    """Pictures to fit, and ``--recursive``."""
    command.add_argument(
        "pictures",
        nargs="+",
        metavar="IMAGE_OR_DIR",
        help=f"{what}, folders of pictures, or patterns such as 'a/*.jpg'",
    )
    command.add_argument("--recursive", action="store_true", help="take pictures in folders within the folders, too")
    add_max_megapixels(command)


def add_model(command: argparse.ArgumentParser) -> None:
    """``--model NAME``."""
    command.add_argument(
        "--model", default=DEFAULT_MODEL, help=f"a bundled model's name or a model file (default: {DEFAULT_MODEL})"
    )


def add_normaliser(command: argparse.ArgumentParser) -> None:
    """``--normaliser NAME``."""
    command.add_argument(
        "--normaliser",
        choices=NORMALISERS,
        help="what distances are divided by: outer eye corners, pupil centres, bounding square, the root of the "
        "bounding box's area, its diagonal, centroid size, or the ends that a scheme of your own names "
        "(default: what the scheme says, or the outer eye corners; the bounding square if labels have no "
        "eye corners, or if faces are turned by more than 45 degrees)",
    )


def add_unshift(command: argparse.ArgumentParser) -> None:
    """``--unshift``."""
    command.add_argument(
        "--unshift",
        action="store_true",
        help="put landmarks onto what they mark: labels that some models learned from lie a pixel or half a "
        "pixel beside it, and so do their fits (docs/measured/label-shift.md)",
    )


def given_unshift(arguments: argparse.Namespace, frame: Frame) -> list[str]:
    """That ``--unshift`` changes nothing of a model with crops in this frame, if it was given and does not."""
    if not arguments.unshift or frame.shift:
        return []
    return [f"--unshift: {arguments.model} knows of no shift of its labels: its fits stay where they are"]


def add_boxes(command: argparse.ArgumentParser, otherwise: str) -> None:
    """``--boxes FILE.csv`` and ``--box-kind KIND``."""
    command.add_argument(
        "--boxes",
        metavar="FILE.csv",
        help="face boxes with the columns image,x,y,width,height, and rotation (degrees, clockwise) if faces "
        "are turned, such as a landmarks.csv; image is a path, or the end of a path that only one picture "
        f"has, such as its file name; without it, {otherwise}",
    )
    command.add_argument(
        "--box-kind",
        metavar="KIND",
        help=f"what drew the boxes of FILE.csv: square (around the landmarks), {', '.join(box_kinds())} "
        "(default: its column box, or square)",
    )


def add_detector(command: argparse.ArgumentParser, about: str) -> None:
    """``--detector SPEC``, and how faces are looked for: ``--smallest``, ``--score`` and ``--any-rotation``."""
    command.add_argument("--detector", metavar="SPEC", help=f"{about}: {', '.join(detector_specs())}")
    command.add_argument(
        "--smallest",
        type=float,
        metavar="PIXELS",
        help="width of the smallest faces to look for, in pixels (default: 24, for dlib 40, and in large "
        "pictures 1/60 of the root of their area); smaller faces take longer",
    )
    command.add_argument(
        "--score",
        type=float,
        help="score, up to 1, from which a find of yunet counts as a face; with a lower one it finds more "
        "faces, and more false ones",
    )
    command.add_argument(
        "--any-rotation",
        action="store_true",
        help="also look at the pictures turned by 90, 180 and 270 degrees; takes four times as long",
    )


def given_search(arguments: argparse.Namespace) -> Search:
    """How ``--smallest``, ``--score`` and ``--any-rotation`` say that faces are looked for.

    Raises:
        InputError: a number out of range.
    """
    return Search(arguments.smallest, arguments.score, arguments.any_rotation)


def unused_rows(names: Sequence[str]) -> str:
    """A warning of names in the file of boxes that no picture has."""
    return f"rows for pictures that were not given: {len(names)}, such as {names[0]}"


def add_starts(command: argparse.ArgumentParser, about: str) -> None:
    """``--starts K`` and ``--rotations LOW HIGH``."""
    usual = _DEFAULT.starts
    command.add_argument("--starts", type=int, default=usual.count, metavar="K", help=f"{about}; one, or three or more")
    command.add_argument(
        "--rotations",
        type=float,
        nargs=2,
        default=(usual.low, usual.high),
        metavar=("LOW", "HIGH"),
        help="range, in degrees clockwise as seen, over which the rotations of several starts are spread evenly",
    )


def given_starts(arguments: argparse.Namespace) -> Starts:
    """The starts that ``--starts`` and ``--rotations`` ask for.

    Raises:
        InputError: there are none, or two; or no range.
    """
    return Starts(arguments.starts, *arguments.rotations)


def given_fitting(arguments: argparse.Namespace) -> Fitting:
    """How the options of `add_detector` and `add_starts` say that faces are found and fitted.

    Raises:
        InputError: a number out of range.
    """
    return Fitting(arguments.detector, given_search(arguments), given_starts(arguments))


def add_heads(command: argparse.ArgumentParser) -> None:
    """``--heads``."""
    command.add_argument(
        "--heads",
        action="store_true",
        help="also find heads with a 2D model, by aligning a 3D head model to its landmarks, which do not move",
    )


def add_camera(command: argparse.ArgumentParser) -> None:
    """``--camera FX FY CX CY``, ``--field-of-view DEGREES`` and ``--pupil-distance MM``."""
    command.add_argument(
        "--camera",
        type=float,
        nargs=4,
        metavar=("FX", "FY", "CX", "CY"),
        help="focal lengths and centre of the camera, in pixels: also find where heads are, in millimetres, and "
        "how they are rotated before the camera; finds heads with 2D models, too",
    )
    command.add_argument(
        "--field-of-view",
        type=float,
        metavar="DEGREES",
        help="instead of --camera: the angle that the width of the picture covers",
    )
    command.add_argument(
        "--pupil-distance",
        type=float,
        metavar="MM",
        help=f"distance of people's pupils, which sets the size of the heads (default: {PUPIL_DISTANCE:g}, the "
        "mean of adults)",
    )


def given_placing(arguments: argparse.Namespace) -> Placing | None:
    """How the options of `add_camera` say that heads are placed before a camera; None: they are not.

    Raises:
        InputError: two cameras, none for a distance of pupils, or a number out of range.
    """
    camera, view, pupils = arguments.camera, arguments.field_of_view, arguments.pupil_distance
    if camera is not None and view is not None:
        raise InputError("expected --camera or --field-of-view; got both")
    if camera is None and view is None:
        if pupils is not None:
            raise InputError("--pupil-distance: expected --camera or --field-of-view with it; got neither")
        return None
    known: Camera = PinholeCamera(*camera) if view is None else FieldOfView(view)
    return Placing(known) if pupils is None else Placing(known, pupils)


def add_refine(command: argparse.ArgumentParser) -> None:
    """``--refine``."""
    command.add_argument(
        "--refine",
        action="store_true",
        help="for models of 3D alignment: adjust 3D shape and camera together after aligning them; slow",
    )


def untrained_starts(name: str, trained: Starts, starts: Starts) -> list[str]:
    """A warning where several starts are asked for of a model that was ``trained`` for one."""
    if starts.count == 1 or trained.count > 1:
        return []
    return [f"{name} was trained for a single start: its fits from several turned starts may all be wrong"]


def add_head_model(command: argparse.ArgumentParser) -> None:
    """``--head-model NAME``."""
    command.add_argument(
        "--head-model",
        default=_DEFAULT.head_model,
        metavar="NAME",
        help="3D head model of 3D methods and --lift: a bundled one's name, or a file that scripts/build_head.py made",
    )


def seed(text: str) -> int:
    """A seed on the command line: a whole number that is not negative."""
    number = whole_number(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"expected a seed of 0 or more; got {text}")
    return number


# How the fields of `Greedy` are read; their defaults are its own.
_GREEDY: dict[str, dict[str, Any]] = {
    "windows": {
        "type": float,
        "nargs": "+",
        "metavar": "SHARE",
        "help": "side of the descriptor window as a share of the face's side, one number for each step; the "
        "thesis has 32 / FACE for every step",
    },
    "augmentations": {"type": int, "help": "starts that are drawn for each face"},
    "variance": {"type": float, "help": "share kept by the features' PCA"},
    "ridge": {"type": float, "help": "ridge strength; 0 is least squares"},
    "rank": {
        "type": int,
        "help": "number of directions that each step is taken along; fewer make a model smaller and faster "
        "(default: all)",
    },
    "spread": {
        "type": float,
        "help": "factor on the spread of the starts (default: 1, or 1.4 for schemes of your own)",
    },
    "seed": {"type": seed, "help": "seed; the same seed, machine and number of cores give the same model"},
    "copies": {
        "type": int,
        "help": "copies of each face with its picture turned, scaled, sheared, blurred or partly hidden "
        "(default: 0, or for schemes of your own as many as make 400 faces, at most 9)",
    },
}


_SUITED = ("spread", "copies")  # whose defaults are those of `options_for`


def add_training(command: argparse.ArgumentParser) -> None:
    """The options of training, whatever the method."""
    for name, words in _GREEDY.items():
        usual = None if name in _SUITED else getattr(_DEFAULT.greedy, name)
        default = list(usual) if isinstance(usual, tuple) else usual
        command.add_argument(f"--{name}", default=default, **words)
    command.add_argument(
        "--shape-variance", type=float, default=_DEFAULT.shape_variance, help="share kept by the shape model's PCA"
    )
    command.add_argument(
        "--sigmas",
        type=float,
        default=_DEFAULT.sigmas,
        help="radius of the ellipsoid that shape coefficients stay in (default: one that holds 99.7 %% of "
        "normal faces)",
    )
    add_head_model(command)
    add_starts(command, "how many starts fits will use; with several, starts are turned in training, too")
    command.add_argument("--no-mirror", action="store_true", help="do not train on mirrored pictures too")
    command.add_argument(
        "--no-detectors", action="store_true", help="do not learn how the boxes of detectors lie; saves minutes"
    )
    command.add_argument(
        "--descriptor",
        choices=list(DESCRIPTORS),
        help="what describes the picture around a landmark: sift, or dense, which is much faster (default: "
        "sift, or dense for schemes of your own)",
    )
    command.add_argument(
        "--zoom",
        type=int,
        choices=ZOOMS,
        help="how many times finer crops are than usual, with dense: later steps look at more detail, and take "
        "longer (default: 1, or 2 for schemes of your own)",
    )
    command.add_argument(
        "--orientation",
        choices=ORIENTATIONS,
        help="orientation of windows (default: face, but upright for sdm from a single start); models with "
        "upright windows do not find turned faces",
    )
    command.add_argument(
        "--normalisation", choices=NORMALISATIONS, help="normalisation of descriptors (default: vector)"
    )
    command.add_argument("--crop", type=int, help="side of the crops, in pixels (default: as suits the descriptor)")
    command.add_argument(
        "--face", type=float, help="side of the face in the crops, in pixels (default: as suits the descriptor)"
    )
    command.add_argument(
        "--shift",
        type=float,
        metavar="PIXELS",
        help="how far labels lie right of and below what they mark; fits of the model do the same (default: 0)",
    )


def add_confidence(command: argparse.ArgumentParser) -> None:
    """``--confidence [FOLDS]``."""
    command.add_argument(
        "--confidence",
        type=int,
        nargs="?",
        const=3,
        metavar="FOLDS",
        help="also learn how likely a fit is to be good (fits.confidence), from fits by models that are trained "
        "on parts of the faces, in 3 folds by default; takes four times as long",
    )


def require_folds(arguments: argparse.Namespace, *names: str) -> None:
    """Refuse options such as ``--confidence`` with too few folds, before the work.

    Raises:
        InputError: there is one.
    """
    for name in names:
        folds = getattr(arguments, name)
        if folds is not None and folds < 2:
            raise InputError(f"--{name}: expected 2 folds or more; got {folds}")


def model_target(out: str) -> Path:
    """The ``--out`` of a command that makes a model: refused, before an hour of work, if it could not be written.

    Raises:
        InputError: it does not end as model files do, or cannot be written to.
    """
    path = Path(out)
    if path.suffix != SUFFIX or path.is_dir() or not os.access(path.parent, os.W_OK):
        raise InputError(
            f"--out: expected a file name ending in {SUFFIX} in a folder that can be written to; got {path}"
        )
    return path


def given_greedy(arguments: argparse.Namespace, usual: Greedy = _DEFAULT.greedy) -> Greedy:
    """The options of how a cascade is learned; those that are not given, as usual.

    Raises:
        InputError: an option out of range.
    """
    given: dict[str, Any] = {name: getattr(arguments, name) for name in _GREEDY}
    given |= {name: getattr(usual, name) for name in _SUITED if given[name] is None}
    return Greedy(**given | {"windows": tuple(given["windows"])})


def training_options(arguments: argparse.Namespace, scheme: Scheme, method: str, faces: int | None = None) -> Options:
    """The options of training that the command line gives, for so many faces; those of unknown landmarks are not
    mirrored. Where nothing is given, they are those of `options_for`, or, for None faces, those of known landmarks.

    Raises:
        InputError: an option out of range, or a choice that the descriptor does not have.
    """
    starts = given_starts(arguments)
    usual = default_descriptor(method, starts)
    suited = _DEFAULT if faces is None else options_for(scheme, faces)
    kind = arguments.descriptor or kind_of(suited.descriptor or usual)
    descriptor: Any = descriptor_like(usual, kind)
    if suited.descriptor is not None and kind == kind_of(suited.descriptor):
        finer: Any = suited.descriptor
        descriptor = replace(finer, orientation=descriptor.orientation)
    for name in ("orientation", "normalisation", "zoom"):
        if choice := getattr(arguments, name):
            if not hasattr(descriptor, name):
                raise InputError(
                    f"the descriptor {kind} has no {name}: leave out --{name}, or take another --descriptor"
                )
            descriptor = replace(descriptor, **{name: choice})
    sides = {name: side for name in ("crop", "face", "shift") if (side := getattr(arguments, name)) is not None}
    return Options(
        greedy=given_greedy(arguments, suited.greedy),
        starts=starts,
        shape_variance=arguments.shape_variance,
        sigmas=arguments.sigmas,
        head_model=arguments.head_model,
        mirror=not arguments.no_mirror and scheme.mirror is not None,
        detectors=not arguments.no_detectors,
        # Left open where it is the usual one, which depends on the other options.
        descriptor=None if descriptor == usual else descriptor,
        frame=replace(descriptor.frame, **sides) if sides else None,
    )


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
