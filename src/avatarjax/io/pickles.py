"""Arrays from pickle files without running what such a file may carry."""

from __future__ import annotations

import os
import pickle
import typing
from pathlib import Path

import numpy as np


def _reconstruct(kind: type, shape: tuple[int, ...], code: bytes) -> np.ndarray:
    """What NumPy's own reconstruction does, for plain arrays only."""
    if kind is not np.ndarray:
        raise pickle.UnpicklingError(f"an array of type {kind!r}")
    return np.ndarray.__new__(kind, shape, np.dtype(code))


# Everything that a pickle of plain NumPy arrays names: NumPy 1 wrote `numpy.core`, NumPy 2 writes `numpy._core`.
_ALLOWED: dict[tuple[str, str], typing.Any] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy._core.multiarray", "_reconstruct"): _reconstruct,
}


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> typing.Any:
        try:
            return _ALLOWED[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is not an array") from None


def load_arrays(path: str | os.PathLike) -> typing.Any:
    """What a pickle file holds, where that is nothing but containers, numbers, texts and plain NumPy arrays.

    Raises ValueError for a missing or damaged file, and for one that names anything else: such a file could run code,
    and none of it is run.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist")
    try:
        with path.open("rb") as file:
            return _ArrayUnpickler(file).load()
    except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged or holds more than arrays: {error}") from error
