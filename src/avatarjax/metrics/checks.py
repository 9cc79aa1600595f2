"""The door of every metric: what is not finite or not of the expected shape is refused by name."""

from __future__ import annotations

import typing

import numpy as np


def finite(name: str, values: typing.Any, shape: tuple[int | None, ...], dtype: typing.Any = np.float64) -> np.ndarray:
    """`values` as an array of `shape`, where None stands for any length of at least one, and `dtype` (None: its own).

    Raises ValueError that says what was given, what was expected and, for numbers that are not finite, where they are.
    """
    array = np.asarray(values, dtype)
    wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or array.size == 0:
        raise ValueError(f"{name} must have the shape {wanted}, none of it 0, but has {array.shape}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        place = ", ".join(map(str, bad[0]))
        raise ValueError(
            f"{name} must be finite, but {len(bad)} of {array.size} numbers are not finite, the first at ({place}): "
            "leave such frames out, or find out what made them"
        )
    return array


def fraction(name: str, value: float) -> float:
    """`value` if it lies strictly between 0 and 1; raises ValueError otherwise."""
    if not 0 < value < 1:
        raise ValueError(f"{name} must lie between 0 and 1, got {value}")
    return value
