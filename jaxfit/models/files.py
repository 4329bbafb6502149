"""Model files: safetensors with one JSON header. Anyone may open them: nothing in them is ever executed."""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import resources
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as parse_tensors
from safetensors.numpy import save as pack_tensors

from jaxfit.cascade.confidence import Confidence, count_moves
from jaxfit.cascade.model import Cascade, Hidden
from jaxfit.cascade.starts import Starts
from jaxfit.cascade.uncertainty import Uncertainty
from jaxfit.data.inputs import read_regular
from jaxfit.data.outputs import atomic_write
from jaxfit.descriptors import DESCRIPTORS
from jaxfit.errors import InputError, JaxfitError, ModelError
from jaxfit.image.frame import Frame
from jaxfit.models.model import Model, trained_starts
from jaxfit.models.placements import Placement, read_placement
from jaxfit.modes import computing
from jaxfit.schemes.own import scheme_json, scheme_of_json
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes import SPACES
from jaxfit.shapes.camera_asm import CameraASM, WeightedCameraASM

FORMAT = 1
SUFFIX = ".safetensors"
BUNDLED = "jaxfit.models"  # the package that models come with
DEFAULT_MODEL = "face68"  # one of them

_KEY = "jaxfit"
# What files call the shape spaces that are aligned to the landmarks of 2D ones.
_ALIGNED = {"camera-asm": CameraASM, "weighted-camera-asm": WeightedCameraASM}
_LEARNED = "learned"  # digests, optional, and no parameters
MOST_BYTES = 1 << 30  # of a file; bundled ones have ten million
_MOST_PLACEMENT = 10.0  # sides of a box, and logarithms: those that were measured are below 1
# What parsing may raise whatever the bytes.
DAMAGE = (
    SafetensorError,
    JaxfitError,
    LookupError,
    ArithmeticError,
    TypeError,
    ValueError,
    AttributeError,
    RecursionError,
)


@computing
def save(model: Model, path: str | Path) -> None:
    """Write a model to ``path`` (ending in ``.safetensors``), atomically; the same model gives the same bytes.

    Weights are stored as float16, the precision that training rounds them to.

    Raises:
        InputError: the name does not end in ``.safetensors``, its folder does not exist, or a weight is too large for
            float16.
    """
    path = Path(path)
    check_target(path)
    cascade = model.cascade
    header = {
        "format": FORMAT,
        "space": _name_of(SPACES, cascade.space),
        "descriptor": {
            "kind": _name_of(DESCRIPTORS, cascade.descriptor),
            **vars(cascade.descriptor),
        },
        **usage_of(model),
        **({} if model.aligned is None else {"aligned": _name_of(_ALIGNED, model.aligned)}),
        "training": model.training,
    }
    learned = {} if model.learned is None else {_LEARNED: model.learned}
    write_tensors(path, tensors_of(model) | learned, _KEY, header)


def bundled() -> list[str]:
    """Names of the models that come with the package."""
    return names_in(BUNDLED)


@computing
def load(name: str | Path = DEFAULT_MODEL) -> Model:
    """Load a bundled model by name, or a model file by path.

    Raises:
        ModelError: no such model, or a file that is damaged or of another format version.
    """
    data = read_named(name, BUNDLED, "model")
    with _named_in_errors(name):
        return _parse(data)


def read_usual_fits(name: str | Path) -> tuple[Frame, Starts]:
    """The frame of a model's crops and the starts that it was trained for, without its arrays: for a process that hands
    the work to others, and need not have JAX take a device.

    Raises:
        ModelError: as `load`, as far as the header says.
    """
    data = read_named(name, BUNDLED, "model")
    with _named_in_errors(name):
        header = read_header(data, _KEY, FORMAT, "model")
        return read_usage(header)[0], trained_starts(header["training"])


@contextmanager
def _named_in_errors(name: str | Path) -> Iterator[None]:
    """Whatever damage raises becomes an error that names the model file."""
    try:
        yield
    except ModelError as error:
        raise ModelError(f"{name}: {error}") from None
    except DAMAGE as error:
        raise ModelError(f"{name}: not a jaxfit model, or damaged ({error}); copy or train it again") from None


def tensors_of(model: Model) -> dict[str, np.ndarray]:
    """The arrays of a model by name, as files hold them: the weights as float16, all others as float32.

    Raises:
        InputError: one is not finite, or a weight is too large for float16.
    """
    cascade = model.cascade
    tensors: dict[str, np.ndarray] = {
        "weights": _half(np.stack(cascade.weights)),
        "biases": np.asarray(cascade.biases, np.float32),
        "windows": np.asarray(cascade.windows, np.float32),
        **({} if cascade.directions is None else {"directions": np.asarray(cascade.directions, np.float32)}),
        **({} if cascade.hidden is None else _hidden_tensors(cascade.hidden)),
        **_arrays("space", cascade.space),
        **({} if model.aligned is None else _arrays("head", model.aligned)),
        **_network_tensors("confidence", model.confidence, ("seen",)),
        **_network_tensors("uncertainty", model.uncertainty, ("seen", "axes")),
    }
    if unfit := [name for name, tensor in tensors.items() if not np.isfinite(tensor).all()]:
        raise InputError(f"{', '.join(unfit)}: not finite, or too large for float16; train with a stronger ridge")
    return tensors


def usage_of(model: Model) -> dict[str, Any]:
    """What a header says of how a model is used: its crops, its landmarks, how faces lie in boxes; JSON values."""
    return {
        "frame": dataclasses.asdict(model.cascade.frame),
        "scheme": scheme_json(model.scheme),
        "placements": {kind: dataclasses.asdict(place) for kind, place in model.placements.items()},
    }


def read_usage(header: dict[str, Any]) -> tuple[Frame, Scheme, dict[str, Placement]]:
    """What `usage_of` says. Damaged headers may raise any of ``DAMAGE``."""
    placements = {kind: _placement(place) for kind, place in header["placements"].items()}
    return Frame(**header["frame"]), scheme_of_json(header["scheme"]), placements


def check_target(path: Path) -> None:
    """Refuse to write a file that could not be loaded again, or not be written.

    Raises:
        InputError: the name does not end in ``.safetensors``, or its folder does not exist.
    """
    if path.suffix != SUFFIX or not path.parent.is_dir():
        raise InputError(f"expected a file name ending in {SUFFIX} in a folder that exists; got {path}")


def write_tensors(path: Path, tensors: dict[str, np.ndarray], key: str, header: dict[str, Any]) -> None:
    """Write arrays with a header, JSON values, under ``key``, atomically; equal ones give equal bytes."""
    # One metadata entry only: the format does not fix the order of several, and equal models must be equal files.
    data = pack_tensors(tensors, {key: json.dumps(header, sort_keys=True)})
    with atomic_write(path) as file:
        file.write(data)


def names_in(package: str) -> list[str]:
    """Names of the files that come with a package of ours, in its folder ``bundled``."""
    files = resources.files(package) / "bundled"
    if not files.is_dir():
        return []
    return sorted(item.name.removesuffix(SUFFIX) for item in files.iterdir() if item.name.endswith(SUFFIX))


def read_named(name: str | Path, package: str, kind: str) -> bytes:
    """The bytes of a file that comes with a package of ours, by name, or of any file, by path; ``kind`` is for the
    message.

    Raises:
        ModelError: no such file.
    """
    names = names_in(package)
    if str(name) in names:
        return (resources.files(package) / "bundled" / f"{name}{SUFFIX}").read_bytes()
    try:
        return read_regular(name, MOST_BYTES)
    except (OSError, ValueError) as error:
        near = "".join(f"; did you mean {known}?" for known in get_close_matches(str(name), names, 1))
        raise ModelError(
            f"no {kind} {str(name)!r}: expected one of the bundled {kind}s ({', '.join(names) or 'none'}) or "
            f"the path of a {kind} file ({getattr(error, 'strerror', None) or error}){near}"
        ) from None


def read_header(data: bytes, key: str, version: int, kind: str, remedy: str = "train") -> dict[str, Any]:
    """The header under ``key`` of a file's bytes, if its format is ``version``.

    ``kind`` is for the message, and so is ``remedy``: the verb of what makes a new one.

    Raises:
        ModelError: there is no such header, or it has another version. Damaged bytes may raise any of ``DAMAGE``.
    """
    length = int.from_bytes(data[:8], "little")
    metadata = json.loads(data[8 : 8 + length]).get("__metadata__", {})
    if key not in metadata:
        raise ModelError(f"not a jaxfit {kind}: a safetensors file without our header")
    header = json.loads(metadata[key])
    if header["format"] != version:
        raise ModelError(
            f"{kind} format {header['format']}, but this release reads format {version}; "
            f"use the release it was made with, or {remedy} it again"
        )
    return header


def _parse(data: bytes) -> Model:
    header = read_header(data, _KEY, FORMAT, "model")
    tensors = parse_tensors(data)
    learned = tensors.pop(_LEARNED, None)
    if learned is not None and (learned.dtype != np.uint64 or learned.ndim != 1 or (learned[1:] <= learned[:-1]).any()):
        raise ModelError(f"damaged: {_LEARNED} has {learned.dtype} {learned.shape}, expected digests, uint64 (N,)")
    frame, scheme, placements = read_usage(header)
    return Model(
        cascade=_cascade(header, tensors, frame, scheme.count),
        scheme=scheme,
        placements=placements,
        aligned=_aligned(header, tensors, scheme.count),
        confidence=_confidence(tensors),
        uncertainty=_uncertainty(tensors, scheme.count),
        training=header["training"],
        learned=learned,
    )


def _cascade(header: dict[str, Any], tensors: dict[str, np.ndarray], frame: Frame, count: int) -> Cascade:
    """The cascade, of ``count`` landmarks."""
    kind: Any = SPACES[header["space"]]
    space = _assembled("space", kind, tensors, {"landmarks": count, "dimensions": kind.dimensions})
    options = dict(header["descriptor"])
    descriptor = DESCRIPTORS[options.pop("kind")](**options)
    steps, features, params = len(tensors["windows"]), count * descriptor.size, space.size
    if not steps:
        raise ModelError("damaged: there are no steps")
    expected = {"biases": (steps, params), "windows": (steps,)}
    if "directions" in tensors:
        rank = tensors["directions"].shape[1]
        expected |= {"weights": (steps, features, rank), "directions": (steps, rank, params)}
    else:
        expected["weights"] = (steps, features, params)
    has_hidden = any(name.startswith("hidden.") for name in tensors)
    if has_hidden:
        outputs, units = expected["weights"][2], tensors["hidden.biases"].shape[-1]
        sizes = {"weights": (outputs, units), "biases": (units,), "output": (units, params)}
        expected |= {f"hidden.{part}": (steps, *shape) for part, shape in sizes.items()}
    for name, shape in expected.items():
        if tensors[name].shape != shape:
            raise ModelError(f"damaged: {name} has shape {tensors[name].shape}, expected {shape}")
    for name, tensor in tensors.items():
        if tensor.dtype not in (np.float16, np.float32) or not np.isfinite(tensor).all():
            raise ModelError(f"damaged: {name} has values that are not finite 16- or 32-bit numbers")
        if name.endswith(".deviations") and not (tensor.size and (tensor > 0).all()):
            raise ModelError(f"damaged: {name} must be larger than 0")
    if not (tensors["windows"] > 0).all():
        raise ModelError("damaged: descriptor windows must be larger than 0")
    return Cascade(
        space=space,
        weights=tuple(jnp.asarray(of_step, jnp.float32) for of_step in tensors["weights"]),
        biases=jnp.asarray(tensors["biases"], jnp.float32),
        windows=jnp.asarray(tensors["windows"], jnp.float32),
        descriptor=descriptor,
        frame=frame,
        directions=jnp.asarray(tensors["directions"], jnp.float32) if "directions" in tensors else None,
        hidden=None
        if not has_hidden
        else Hidden(*(jnp.asarray(tensors[f"hidden.{part}"], jnp.float32) for part in Hidden._fields)),
    )


def _aligned(header: dict[str, Any], tensors: dict[str, np.ndarray], count: int) -> CameraASM | None:
    """What a model of 3D alignment aligns, of ``count`` landmarks; earlier versions knew one kind, and did not say."""
    if not any(name.startswith("head.") for name in tensors):
        return None
    kind: Any = _ALIGNED[header.get("aligned", "camera-asm")]
    return _assembled("head", kind, tensors, {"landmarks": count, "dimensions": 3})


def _hidden_tensors(hidden: Hidden) -> dict[str, np.ndarray]:
    return {f"hidden.{part}": np.asarray(value, np.float32) for part, value in hidden._asdict().items()}


def _network_tensors(name: str, network: Any, large: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The arrays of a network, its ``large`` ones as float16."""
    if network is None:
        return {}
    return _arrays(name, network) | {f"{name}.{part}": _half(np.asarray(getattr(network, part))) for part in large}


def _confidence(tensors: dict[str, np.ndarray]) -> Confidence | None:
    """How likely fits of the cascade whose tensors these are, which have been checked, are good."""
    if not any(name.startswith("confidence.") for name in tensors):
        return None
    steps, features = tensors["weights"].shape[:2]
    return _assembled("confidence", Confidence, tensors, {"features": features, "moves": count_moves(steps)})


def _uncertainty(tensors: dict[str, np.ndarray], count: int) -> Uncertainty | None:
    """How far the ``count`` landmarks of fits of the cascade whose tensors these are, which have been checked, may be
    off."""
    if not any(name.startswith("uncertainty.") for name in tensors):
        return None
    steps, features = tensors["weights"].shape[:2]
    sizes = {"features": features, "moves": count_moves(steps), "landmarks": count, "descriptor": features // count}
    return _assembled("uncertainty", Uncertainty, tensors, sizes)


def _arrays(name: str, part: Any) -> dict[str, np.ndarray]:
    """The arrays of a shape space by name; a dataclass in it gives its own fields."""
    if not dataclasses.is_dataclass(part):
        return {name: np.asarray(part, np.float32)}
    return {
        key: array for field, value in vars(part).items() for key, array in _arrays(f"{name}.{field}", value).items()
    }


def _assembled(name: str, kind: Any, tensors: dict[str, np.ndarray], sizes: dict[str, int]) -> Any:
    """A shape space of class ``kind`` from the arrays that ``_arrays`` gives; ``sizes`` are those of its dimensions."""
    if hasattr(kind, "__dataclass_fields__"):
        fields = dataclasses.fields(kind)
        return kind(**{field.name: _assembled(f"{name}.{field.name}", field.type, tensors, sizes) for field in fields})
    shape, dimensions = tensors[name].shape, kind.dim_str.split()
    expected = [int(d) if d.isdecimal() else sizes.setdefault(d, n) for d, n in zip(dimensions, shape, strict=False)]
    if len(shape) != len(dimensions) or list(shape) != expected:
        raise ModelError(f"damaged: {name} has shape {shape}, expected ({', '.join(dimensions)}) with {sizes}")
    return jnp.asarray(tensors[name], jnp.float32)


def _half(weights: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):  # infinities are refused with a message of ours
        return weights.astype(np.float16)


def _placement(values: dict[str, Any]) -> Placement:
    placement = read_placement(values)
    spread = placement.spread
    if not np.isfinite([*placement.shift, placement.log_scale, *spread.shift, spread.log_scale, spread.rotation]).all():
        raise ModelError("damaged: a placement has values that are not finite numbers")
    largest = max(map(abs, (*placement.shift, placement.log_scale)))
    if largest > _MOST_PLACEMENT or not all(
        0 <= value <= _MOST_PLACEMENT for value in (*spread.shift, spread.log_scale, spread.rotation)
    ):
        raise ModelError(
            f"damaged: a placement lies over {_MOST_PLACEMENT:g} sides from its box, or is as much larger, or spread"
        )
    return placement


def _name_of(names: Mapping[str, type], thing: object) -> str:
    return next(name for name, kind in names.items() if type(thing) is kind)
