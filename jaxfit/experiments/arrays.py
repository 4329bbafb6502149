"""Files of named arrays: the results of an experiment's tasks, and what is known of its faces."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from jaxfit.data.outputs import atomic_write
from jaxfit.errors import InputError

Arrays = dict[str, np.ndarray]


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays, none of them of objects, as NumPy's npz, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_arrays(path: Path, names: Sequence[str] | None = None) -> Arrays:
    """The arrays of a file of `save_arrays`, all or those of these names.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names or arrays.files}
    except FileNotFoundError:
        raise InputError(f"{path}: is missing; run the experiment again, which writes it") from None
    except (ValueError, OSError, EOFError, KeyError, BadZipFile) as error:
        raise InputError(f"{path}: is damaged ({error}); delete it and run the experiment again") from None
