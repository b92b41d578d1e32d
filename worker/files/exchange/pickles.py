"""Pickled NumPy files of others, read without running what is in them.

A pickle may name any function to be called while it is read. Only arrays, numbers, words and their containers are
let through here.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from service.model.base import why
from service.model.errors import InputError

_HARMLESS: Final = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
    ("numpy._core.numeric", "_frombuffer"),
}


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _HARMLESS:
            raise pickle.UnpicklingError(f"it would run {module}.{name}")
        return super().find_class(module, name)


def load_npy(path: Path) -> Any:
    """What a `.npy` file holds: an array, or the one object in it.

    Raises:
        InputError: no NumPy file, or one that would run code.
    """
    try:
        with path.open("rb") as file:
            if (array := _plain(file)) is not None:
                return array
            found = _Reader(file).load()
    except pickle.UnpicklingError as error:
        raise InputError(f"{path} cannot be read safely: {error}") from None
    except Exception as error:  # a pickle of a stranger may raise anything
        raise InputError(f"{path} is no NumPy file: {why(error)}") from None
    return found.item() if isinstance(found, np.ndarray) and found.shape == () else found


def _plain(file: BinaryIO) -> np.ndarray | None:
    """The array, if it has no objects; else the file is left where its pickle begins."""
    version = np.lib.format.read_magic(file)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    _, _, dtype = header(file)
    if dtype.hasobject:
        return None
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
