"""Sheets that lie on a figure and hang from it: rows of points that crawl down over a body and fall where it ends."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from avatarjax.data.wardrobe import paths
from avatarjax.data.wardrobe.ground import Ground


def outward(
    points: Float[np.ndarray, "v 3"], centre: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Where rays from a centre along unit directions leave a round cloud of points (a head): (n, 3), metres."""
    offset = points - centre
    length = np.linalg.norm(offset, axis=1)
    cosine = directions @ (offset / length[:, None]).T
    share = np.exp((cosine - 1) / 0.004)
    return centre + directions * ((share * length).sum(1) / share.sum(1))[:, None]


def fall(
    start: Float[np.ndarray, "n 3"],
    lengths: Float[np.ndarray, " n"],
    rows: int,
    lie_on: Ground,
    *,
    pull: Callable[[np.ndarray, np.ndarray], np.ndarray],
    gap: float = 0.01,
    ease: int = 3,
    smooth: float = 0.5,
) -> Float[np.ndarray, "r n 3"]:
    """Rows (rows, n, 3) of a sheet whose upper edge is `start` (n, 3) and whose columns are `lengths` (n,) metres long.

    Each step goes along pull(points, metres walked (n,)) (n, 3), without its part into the ground; every row but the
    first is `gap` metres clear (reached within `ease` rows), and smoothed along the row by `smooth` in [0, 1].
    """
    found, steps = [start], lengths / (rows - 1)
    for i in range(1, rows):
        p = found[-1]
        direction = pull(p, steps * i)
        height, normal = lie_on.height(p)
        touching = np.clip((0.05 + gap - height) / 0.05, 0, 1)[:, None]
        into = np.minimum((direction * normal).sum(1, keepdims=True), 0)
        direction = direction - touching * into * normal
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-6)
        p = p + direction * steps[:, None]
        middle = (p[:-2] + 2 * p[1:-1] + p[2:]) / 4
        p[1:-1] += smooth * (middle - p[1:-1])
        found.append(lie_on.clear(p, gap * min(i / ease, 1.0)))
    return np.stack(found)


def even_grid(rows: Float[np.ndarray, "r n 3"], hem: int = 1, rounds: int = 3) -> Float[np.ndarray, "r n 3"]:
    """The sheet with its vertices moved within it: evenly spaced down each column and, above the last `hem` rows, along
    each row."""
    rows = rows.copy()
    for _ in range(rounds):
        rows[:-hem] = np.stack([paths.even(row, len(row)) for row in rows[:-hem]])
        rows = np.stack([paths.even(column, len(rows)) for column in rows.transpose(1, 0, 2)], axis=1)
    return rows


def settle(points: Float[np.ndarray, "r n 3"], lie_on: Ground, gap: float) -> Float[np.ndarray, "r n 3"]:
    """The sheet (r, n, 3) evenly meshed and, from its fourth row on, `gap` metres clear of the ground."""
    gaps = np.repeat(gap * np.minimum(np.arange(len(points)) / 3, 1.0), points.shape[1])
    for _ in range(3):
        points = lie_on.clear(points.reshape(-1, 3), gaps).reshape(points.shape)
        points = even_grid(points, rounds=1)
    return points
