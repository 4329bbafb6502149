"""Files of tensors with a header, as models and head models are kept: changed ones, and what loading them gives."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from safetensors.numpy import load as unpack
from safetensors.numpy import save as pack

from jaxfit.errors import ModelError

T = TypeVar("T")


def header_of(data: bytes, key: str) -> Any:
    length = int.from_bytes(data[:8], "little")
    return json.loads(json.loads(data[8 : 8 + length])["__metadata__"][key])


def repack(key: str, data: bytes, change: Callable[[Any], object] = lambda header: None, **tensors: Any) -> bytes:
    """A well-formed file whose header under ``key`` and tensors were changed; a tensor that is None is left out."""
    header = header_of(data, key)
    change(header)
    arrays: dict[str, np.ndarray] = {
        name: array for name, array in (unpack(data) | tensors).items() if array is not None
    }
    return pack(arrays, {key: json.dumps(header)})


def load_bytes(load: Callable[[Path], T], path: Path, data: bytes) -> T | str:
    """What a file of these bytes holds, or the words of the ModelError. Any other exception fails the test."""
    path.write_bytes(data)
    try:
        return load(path)
    except ModelError as error:
        return str(error)
