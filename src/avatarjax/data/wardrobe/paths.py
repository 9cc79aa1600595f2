"""Lines in space: how far one has walked along them, points at even distances, and rings around them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def walked(line: Float[np.ndarray, "r ..."]) -> Float[np.ndarray, "r ..."]:
    """Metres along a polyline (r, 3) from its first point (r,); along each column of a sheet (r, n, 3), (r, n)."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=-1)
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


def even(line: Float[np.ndarray, "n 3"], count: int, *, closed: bool = False) -> Float[np.ndarray, "c 3"]:
    """`count` points (count, 3) spaced evenly along a polyline (n, 3); a closed one starts at its first point and does
    not repeat it."""
    if closed:
        line = np.concatenate([line, line[:1]])
    along = walked(line)
    at = np.linspace(0, along[-1], count + closed)[:count]
    return np.stack([np.interp(at, along, line[:, k]) for k in range(3)], axis=1)


def through(knots: Float[np.ndarray, "k 3"], count: int) -> Float[np.ndarray, "n 3"]:
    """`count` points (n, 3) at even distances along a smooth curve through knots (k, 3)."""
    from scipy.interpolate import CubicSpline

    lengths = walked(knots)
    return even(CubicSpline(lengths, knots)(np.linspace(0, lengths[-1], 40 * count)), count)


def tangents(path: Float[np.ndarray, "n 3"], *, closed: bool = False) -> Float[np.ndarray, "n 3"]:
    """Unit directions (n, 3) along a path (n, 3), whose last point is before its first if it is closed."""
    along = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def frame(along: Float[np.ndarray, "n 3"], aside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit directions (n, 3) square to unit tangents (n, 3) and to each other: one across `aside` (3,) or (n, 3),
    and one as near to `aside` as can be."""
    across = np.cross(along, aside)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return across, np.cross(across, along)


def rings(
    path: Float[np.ndarray, "n 3"],
    first: Float[np.ndarray, "n 3"],
    quarter: Float[np.ndarray, "n 3"],
    columns: int,
) -> Float[np.ndarray, "n c 3"]:
    """Ellipses (n, columns, 3) around a path (n, 3), whose half axes (n, 3), metres, reach to the `first` vertex of
    each and to the one a `quarter` of the way around."""
    angles = np.arange(columns)[:, None] * 2 * np.pi / columns
    return path[:, None] + first[:, None] * np.cos(angles) + quarter[:, None] * np.sin(angles)


def rope(
    path: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, " n"], columns: int, *, closed: bool
) -> Float[np.ndarray, "n c 3"]:
    """Rings (n, columns, 3) of the radii (n,) around a path (n, 3), metres; the first vertex of each is outermost from
    the y axis or, where the path is upright, ahead."""
    along = tangents(path, closed=closed)
    outer = path * np.array([1.0, 0, 1.0])
    outer -= (outer * along).sum(1, keepdims=True) * along
    outer *= radius[:, None] / np.linalg.norm(outer, axis=1, keepdims=True)
    return rings(path, outer, np.cross(along, outer), columns)
