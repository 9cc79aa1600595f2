"""Sheets that lie on a figure and hang from it: rows of points that crawl down over a body and fall where it ends."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree


@dataclasses.dataclass(frozen=True, eq=False)
class Ground:
    """What a sheet lies on: points (v, 3) of closed surfaces, metres, and their outward normals (v, 3)."""

    points: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    tree: cKDTree

    def height(self, p: Float[np.ndarray, "n 3"], count: int = 5) -> tuple[np.ndarray, np.ndarray]:
        """Metres (n,) that points are above the nearest surface, and the surface's normals there (n, 3)."""
        distance, nearest = self.tree.query(p, k=count)
        share = 1 / np.maximum(distance, 1e-4) ** 2
        share = (share / share.sum(1, keepdims=True))[..., None]
        normal = (self.normals[nearest] * share).sum(1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return ((p - (self.points[nearest] * share).sum(1)) * normal).sum(1), normal

    def clear(self, p: Float[np.ndarray, "n 3"], gap: np.ndarray | float, rounds: int = 6) -> np.ndarray:
        """The points (n, 3), pushed out until every one of its near neighbours on the surface is `gap` metres below."""
        p, gap = p.copy(), np.broadcast_to(np.asarray(gap, float), len(p))
        for _ in range(rounds):
            _, nearest = self.tree.query(p, k=8)
            offset = p[:, None] - self.points[nearest]
            normal = self.normals[nearest]
            height = (offset * normal).sum(-1)
            across = np.linalg.norm(offset - height[..., None] * normal, axis=-1)
            # A neighbour's tangent plane speaks only for its surroundings, and not for the other side of a limb.
            lack = np.clip(gap[:, None] - height, 0, 0.05) * (across < 0.03) * (height > -0.08)
            worst = lack.argmax(1)[:, None]
            p += np.take_along_axis(normal, worst[..., None], 1)[:, 0] * np.take_along_axis(lack, worst, 1)
        return p


def ground(*surfaces: tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 3"]]) -> Ground:
    """A ground of several surfaces, each (points, normals)."""
    points = np.concatenate([s[0] for s in surfaces]).astype(np.float64)
    normals = np.concatenate([s[1] for s in surfaces]).astype(np.float64)
    return Ground(points, normals, cKDTree(points))


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


def even(line: Float[np.ndarray, "n 3"], count: int, *, closed: bool = False) -> Float[np.ndarray, "c 3"]:
    """`count` points (count, 3) spaced evenly along a polyline (n, 3); a closed one starts at its first point and does
    not repeat it."""
    if closed:
        line = np.concatenate([line, line[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0, along[-1], count + closed)[:count]
    return np.stack([np.interp(at, along, line[:, k]) for k in range(3)], axis=1)


def even_grid(rows: Float[np.ndarray, "r n 3"], hem: int = 1, rounds: int = 3) -> Float[np.ndarray, "r n 3"]:
    """The sheet with its vertices moved within it: evenly spaced down each column and, above the last `hem` rows, along
    each row."""
    rows = rows.copy()
    for _ in range(rounds):
        rows[:-hem] = np.stack([even(row, len(row)) for row in rows[:-hem]])
        rows = np.stack([even(column, len(rows)) for column in rows.transpose(1, 0, 2)], axis=1)
    return rows


def walked(rows: Float[np.ndarray, "r n 3"]) -> Float[np.ndarray, "r n"]:
    """Metres along each column from the first row."""
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=-1)
    return np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(steps, axis=0)])
