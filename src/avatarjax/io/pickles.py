"""Arrays from pickle files without running what such a file may carry."""

from __future__ import annotations

import os
import pickle
import typing
from collections.abc import Callable
from pathlib import Path

import numpy as np


def _reconstruct(kind: type, shape: tuple[int, ...], code: bytes) -> np.ndarray:
    """What NumPy's own reconstruction does, for plain arrays only."""
    if kind is not np.ndarray:
        raise pickle.UnpicklingError(f"an array of type {kind!r}")
    return np.ndarray.__new__(kind, shape, np.dtype(code))


def _scalar(dtype: np.dtype, code: bytes) -> typing.Any:
    """A NumPy number from its bytes."""
    if dtype.hasobject or len(code) != dtype.itemsize:
        raise pickle.UnpicklingError(f"a scalar of type {dtype!r} in {len(code)} bytes")
    return np.frombuffer(code, dtype)[0]


def _encode(text: str, encoding: str) -> bytes:
    """How pickles of protocol 2 spell bytes."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes in the encoding {encoding!r}")
    return text.encode("latin1")


# Everything that a pickle of plain NumPy arrays names: NumPy 1 wrote `numpy.core`, NumPy 2 writes `numpy._core`.
_ALLOWED: dict[tuple[str, str], typing.Any] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy._core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy._core.multiarray", "scalar"): _scalar,
    ("_codecs", "encode"): _encode,
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
    return _load(Path(path), lambda file: _ArrayUnpickler(file).load())


def load_npy(path: str | os.PathLike) -> typing.Any:
    """What a .npy file holds: an array, or the one object (a dictionary of arrays) that `numpy.save` wrapped in one.

    Objects are read as `load_arrays` reads them, and the same errors are raised.
    """
    return _load(Path(path), _read_npy)


def _read_npy(file: typing.BinaryIO) -> typing.Any:
    version = np.lib.format.read_magic(file)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(file)
    if not dtype.hasobject:
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)
    found = _ArrayUnpickler(file).load()
    if not isinstance(found, np.ndarray) or found.shape != shape:
        raise pickle.UnpicklingError(f"no array of shape {shape}")
    return found.item() if found.shape == () else found


def _load(path: Path, read: Callable[[typing.BinaryIO], typing.Any]) -> typing.Any:
    if not path.is_file():
        raise ValueError(f"{path} does not exist")
    try:
        with path.open("rb") as file:
            return read(file)
    except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged or holds more than arrays: {error}") from error
