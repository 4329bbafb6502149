"""Exporting models: one file of programs and their arrays that fits faces without this package, through JAX alone."""

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from numpy.typing import ArrayLike
from safetensors.numpy import load as parse_tensors

from jaxfit.cascade.fit import find
from jaxfit.cascade.starts import Starts
from jaxfit.data.inputs import read_regular
from jaxfit.errors import InputError, ModelError
from jaxfit.fitting.batches import BATCHES
from jaxfit.image.frame import Frame
from jaxfit.models.files import (
    DAMAGE,
    MOST_BYTES,
    check_target,
    read_header,
    read_usage,
    tensors_of,
    usage_of,
    write_tensors,
)
from jaxfit.models.model import Model
from jaxfit.models.placements import Placement
from jaxfit.modes import computing
from jaxfit.schemes.scheme import Scheme

EXPORT_FORMAT = 1
# What programs are lowered for; neither has to be at hand.
PLATFORMS = ("cpu", "cuda")

_KEY = "jaxfit-export"
# What programs may call outside themselves: those of 3D alignment solve linear systems, on CPUs and GPUs; others call
# nothing.
_CUSTOM_CALL = re.compile(r"custom_call[^@\n]*?@\"?([^\s\"(]+)")
_KNOWN_CALLS = frozenset(["lapack_sgetrf_ffi", "lapack_strsm_ffi", "cusolver_getrf_ffi", "cu_lu_pivots_to_permutation"])
_LOCATIONS = "jax_traceback_in_locations_limit"
_FLATBUFFERS = 'exported models need flatbuffers, which JAX stores programs with: pip install "jaxfit[export]"'
_UNITS = {
    "landmarks": "crop pixels: x right, y down, 0 at the centre of the first pixel",
    "landmarks_3d": "crop pixels: x, y and the depth away from the viewer, 0 at the mean face's centroid",
    "pose": "degrees: roll clockwise as seen, pitch up, yaw with the nose to the image's left",
    "scale": "crop pixels per pixel of the canonical face",
    "b": "coefficients of the 3D shape model",
    "confidence": "probability that the fit is good",
    "covariances": "crop pixels²: of the errors of each landmark in x and y",
    "visible": "probability that a landmark can be seen",
}


@dataclass(frozen=True, eq=False)
class Exported:
    """An exported model, ready to fit crops.

    Attributes:
        frame: size of the crops.
        scheme: what the landmarks mean.
        placements: for each kind of face box, where faces lie in it.
        outputs: what is found, by name, with its ``dtype``, its ``shape``, ``"N"`` first, and its ``unit``.
        starts: of each face.
        programs: for each size of batch, large ones first, what fits as many crops.
        arrays: what every program takes beside the crops: the model's arrays by name.
    """

    frame: Frame
    scheme: Scheme
    placements: dict[str, Placement]
    outputs: dict[str, dict[str, Any]]
    starts: Starts
    programs: dict[int, Callable[[np.ndarray, dict[str, jax.Array]], dict[str, jax.Array]]]
    arrays: dict[str, jax.Array]

    def __repr__(self) -> str:
        crops = f"{self.frame.crop} x {self.frame.crop} crops"
        return f"<exported jaxfit model: {', '.join(self.outputs)} of {self.scheme.name} in {crops}>"

    @computing
    def __call__(self, crops: ArrayLike) -> dict[str, np.ndarray]:
        """What is found in any number of crops, as ``outputs`` says; not finite where a fit diverged.

        Args:
            crops: (N, side, side) uint8, grey, of ``frame``, the expected face upright in the middle, as
                ``jaxfit.crop_faces`` cuts them.

        Raises:
            InputError: crops of another size or type.
        """
        crops, side = np.asarray(crops), self.frame.crop
        if crops.dtype != np.uint8 or crops.shape[1:] != (side, side):
            raise InputError(f"expected crops as a uint8 array (N, {side}, {side}); got {crops.dtype} {crops.shape}")
        parts = [{name: np.zeros((0, *of["shape"][1:]), of["dtype"]) for name, of in self.outputs.items()}]
        done = 0
        for size, program in self.programs.items():
            while len(crops) - done >= size:
                found = program(crops[done : done + size], self.arrays)
                parts.append({name: np.asarray(found[name]) for name in self.outputs})
                done += size
        return {name: np.concatenate([part[name] for part in parts]) for name in self.outputs}


@computing
def export_model(model: Model, path: str | Path, starts: Starts = Starts()) -> None:
    """Write a model as programs, to ``path`` (ending in ``.safetensors``), atomically, for use without this package.

    The same model gives the same bytes with the same JAX. Newer releases of JAX read the file for some months only:
    keep the model, too. docs/reference/exported-files.md says what is in the file.

    Args:
        model: what to export.
        path: the file.
        starts: of each face, as in ``jaxfit.fit``.

    Raises:
        InputError: the name does not end in ``.safetensors``, its folder does not exist, a weight is too large for
            float16, or flatbuffers is not installed.
    """
    path = Path(path)
    check_target(path)
    tensors = tensors_of(model)
    # A step's weights apart: programs would copy their part of a larger array, megabytes, before each use.
    tensors |= {f"weights.{step}": of_step for step, of_step in enumerate(tensors.pop("weights"))}
    with _no_source_locations():
        programs = {size: _program(model, starts, tensors, size) for size in BATCHES}
    one = programs[BATCHES[0]]
    crops = one.in_avals[0]
    found = jax.tree.unflatten(one.out_tree, one.out_avals)
    try:
        stored = {f"fit_{size}": np.frombuffer(program.serialize(), np.uint8) for size, program in programs.items()}
    except ImportError as error:
        raise InputError(_FLATBUFFERS) from error
    header = {
        "format": EXPORT_FORMAT,
        "jax": jax.__version__,
        "calling_convention": one.calling_convention_version,
        "platforms": list(one.platforms),
        **usage_of(model),
        "initialisations": starts.count,
        "rotations": [starts.low, starts.high],
        "batches": list(BATCHES),
        "inputs": {"crops": _described(crops, "grey values, 0 is black")},
        "outputs": {name: _described(values, _UNITS[name]) for name, values in found.items()},
    }
    tensors |= stored
    write_tensors(path, tensors, _KEY, header | {"sha256": _checksum(header, tensors)})


@computing
def load_exported(path: str | Path) -> Exported:
    """Load what `export_model` wrote. It is a program, and will be run: load files that you trust.

    Raises:
        ModelError: no such file, or one that is damaged, of another format version, or not for this version of JAX.
        InputError: flatbuffers is not installed.
    """
    try:
        data = read_regular(path, MOST_BYTES)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise ModelError(f"no exported model {str(path)!r}: expected the path of a file ({why})") from None
    try:
        return _parse(data)
    except ImportError as error:
        raise InputError(_FLATBUFFERS) from error
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None
    except DAMAGE as error:
        raise ModelError(f"{path}: not an exported model, or damaged ({error}); copy or export it again") from None


def _program(model: Model, starts: Starts, tensors: dict[str, np.ndarray], size: int) -> export.Exported:
    """The function from ``size`` crops and the model's arrays, float32 by name, to what is found, by name."""
    whole = {
        "cascade": model.cascade,
        "head": model.aligned,
        "confidence": model.confidence,
        "uncertainty": model.uncertainty,
    }
    leaves, structure = jax.tree_util.tree_flatten_with_path(whole)
    # What names of model files are made of: fields, in those of a cascade, a head or a confidence.
    names = [jax.tree_util.keystr(at, simple=True, separator=".").removeprefix("cascade.") for at, _ in leaves]

    def fit(crops: jax.Array, arrays: dict[str, jax.Array]) -> dict[str, jax.Array]:
        parts = jax.tree.unflatten(structure, [arrays[name] for name in names])
        networks = {name: parts[name] for name in ("confidence", "uncertainty")}
        return find(parts["cascade"], parts["head"], crops, starts.rotations, **networks)

    side = model.cascade.frame.crop
    # Arguments, and not constants of the programs: the file then holds them once, as float16, and not for each size.
    arrays = {name: jax.ShapeDtypeStruct(tensors[name].shape, jnp.float32) for name in tensors}
    return export.export(jax.jit(fit), platforms=PLATFORMS)(jax.ShapeDtypeStruct((size, side, side), jnp.uint8), arrays)


@contextmanager
def _no_source_locations() -> Iterator[None]:
    """Programs would say in which files of this machine their lines stand, and no two machines' would be equal."""
    before = getattr(jax.config, _LOCATIONS)
    jax.config.update(_LOCATIONS, 0)
    try:
        yield
    finally:
        jax.config.update(_LOCATIONS, before)


def _described(values: Any, unit: str) -> dict[str, Any]:
    """What the header says of an array with a leading axis of faces."""
    return {"dtype": str(values.dtype), "shape": ["N", *values.shape[1:]], "unit": unit}


def _checksum(header: dict[str, Any], tensors: dict[str, np.ndarray]) -> str:
    """SHA-256 of all that a file says: a flipped bit in a program could do anything."""
    checksum = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        checksum.update(f"{name} {tensor.dtype} {tensor.shape}".encode())
        checksum.update(tensor.tobytes())
    return checksum.hexdigest()


def _parse(data: bytes) -> Exported:
    header = read_header(data, _KEY, EXPORT_FORMAT, "exported model", remedy="export")
    tensors = parse_tensors(data)
    if header.pop("sha256") != _checksum(header, tensors):
        raise ModelError("damaged: the checksum is not that of the contents; copy or export it again")
    frame, scheme, placements = read_usage(header)
    programs = {size: _deserialized(tensors.pop(f"fit_{size}"), header) for size in header["batches"]}
    return Exported(
        frame=frame,
        scheme=scheme,
        placements=placements,
        outputs=header["outputs"],
        starts=Starts(header["initialisations"], *header["rotations"]),
        programs={size: jax.jit(program.call) for size, program in programs.items()},
        arrays={name: jnp.asarray(tensor, jnp.float32) for name, tensor in tensors.items()},
    )


def _deserialized(data: np.ndarray, header: dict[str, Any]) -> export.Exported:
    """The program in an undamaged file.

    Raises:
        ModelError: this version of JAX does not read it, or it calls other code than ours does.
    """
    oldest = export.minimum_supported_calling_convention_version
    newest = export.maximum_supported_calling_convention_version
    why = f"calling convention {header['calling_convention']}, expected {oldest} to {newest}"
    code = None
    if oldest <= header["calling_convention"] <= newest:
        try:
            program = export.deserialize(bytearray(data))
            code = program.mlir_module()  # which calls would read, and find too new or too old
        except (RuntimeError, *DAMAGE) as error:
            why = str(error)
    if code is not None:
        if unknown := sorted({*_CUSTOM_CALL.findall(code)} - _KNOWN_CALLS):
            raise ModelError(
                f"its programs call {', '.join(unknown)}: code of this machine that jaxfit's programs do not call; "
                "do not run it"
            )
        return program
    raise ModelError(
        f"exported by JAX {header['jax']}, which JAX {jax.__version__} does not read ({why}); "
        "use that version, or export the model again"
    )
