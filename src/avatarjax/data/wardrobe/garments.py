"""Pieces of clothing and hair as small meshes grown around a shaped body: skirt, boots, hat, hair."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import fabrics
from avatarjax.physics.cloth import Fabric

# A number, or one for each element.
_Edge = np.ndarray | np.floating | float


@dataclasses.dataclass(frozen=True, eq=False)
class Piece:
    """A part of an avatar in its rest pose, which for cloth is also its pattern: the lengths it keeps.

    vertices (v, 3) metres; faces (f, 3); uvs (f, 3, 2) corners in the unit square of the piece, for cloth along its
    threads; weights (v, j), rows sum to 1; reach (v,) metres that a vertex may leave the place where the skeleton
    carries it: 0 rides on the bones, more is simulated as `fabric`; braces (b, 2) pairs of vertices that keep their
    distance though no edge joins them (a braid stays round); solid: cloth collides with this piece.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uvs: Float[np.ndarray, "f 3 2"]
    weights: Float[np.ndarray, "v j"]
    reach: Float[np.ndarray, " v"] | None = None
    braces: Int[np.ndarray, "b 2"] | None = None
    fabric: Fabric = fabrics.COTTON
    solid: bool = True


def grid_faces(rows: int, columns: int, *, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (f, 3) of a grid of rows x columns vertices and their corner uvs (f, 3, 2); closed joins the last
    column to the first. u runs along the columns, v from 1 at the first row to 0 at the last. Seen with rows going
    down and columns going counter-clockwise about +y (from +z to +x), the triangles face outwards."""
    quads = columns if closed else columns - 1
    r, c = (a.ravel() for a in np.meshgrid(np.arange(rows - 1), np.arange(quads), indexing="ij"))
    corner_rows = np.stack([r, r + 1, r + 1, r], axis=1)
    corner_columns = np.stack([c, c, c + 1, c + 1], axis=1)
    vertex = corner_rows * columns + corner_columns % columns
    uv = np.stack([corner_columns / quads, 1 - corner_rows / (rows - 1)], axis=-1).astype(np.float32)
    faces = np.concatenate([vertex[:, [0, 1, 2]], vertex[:, [0, 2, 3]]])
    return faces.astype(np.int32), np.concatenate([uv[:, [0, 1, 2]], uv[:, [0, 2, 3]]])


def one_bone(rig: Rig, name: str, count: int) -> np.ndarray:
    """Skinning weights (count, j) that are all on one bone."""
    weights = np.zeros((count, len(rig.names)), np.float32)
    weights[:, rig.index(name)] = 1
    return weights


def smoothstep(x: np.ndarray, low: _Edge, high: _Edge) -> np.ndarray:
    """0 below low, 1 above high (or the other way round where high < low), smooth between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def outline(points: np.ndarray, centre: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Distance (k,) of the convex outline of points (n, 2) from a centre, along directions (sin, cos) of angles
    (k,)."""
    directions = np.stack([np.sin(angles), np.cos(angles)], axis=1)
    support = ((points - centre) @ directions.T).max(axis=0)
    # The convex outline is the intersection of its supporting half-planes.
    facing = directions @ directions.T
    reach = np.where(facing > 0.05, support[None] / np.maximum(facing, 0.05), np.inf)
    return reach.min(axis=1)


def skirt(
    rig: Rig,
    body: Float[np.ndarray, "v 3"],
    *,
    top: float,
    bottom: float,
    flare: float = 0.32,
    margin: float = 0.012,
    fabric: Fabric = fabrics.DENIM,
    folds: int = 11,
    rows: int = 26,
    columns: int = 66,
) -> Piece:
    """A skirt from height `top` to `bottom` around the body vertices (v, 3) (without arms); its upper rows are sewn on.

    `flare` is the outward slope, `margin` the distance from the skin, both in metres (per metre).
    """
    angles = np.arange(columns) * 2 * np.pi / columns
    heights = np.linspace(top, bottom, rows)
    centre = np.array([0.0, rig.heads[rig.index("Hips"), 2]])
    radius = np.zeros((rows, columns))
    for i, y in enumerate(heights):
        slab = body[np.abs(body[:, 1] - y) < 0.03][:, [0, 2]]
        fitted = outline(slab, centre, angles) + margin
        fall = heights[i - 1] - y if i else 0.0
        radius[i] = np.maximum(fitted, radius[i - 1] + flare * fall) if i else fitted
    drop = (top - heights) / (top - bottom)
    ripple = 0.018 * drop[:, None] ** 1.5 * np.cos(folds * angles + 0.5 * np.sin(2 * angles))[None]
    radius = radius + ripple
    outward = np.stack([np.sin(angles), np.zeros(columns), np.cos(angles)], axis=1)
    points = outward[None] * radius[..., None] + np.array([centre[0], 0, centre[1]])
    points[..., 1] = heights[:, None]
    vertices = points.reshape(-1, 3).astype(np.float32)
    faces, uvs = grid_faces(rows, columns, closed=True)

    weights = one_bone(rig, "Hips", len(vertices))
    reach = np.repeat(np.clip(drop - 0.08, 0, None), columns) * (top - bottom) * 1.6
    return Piece("skirt", vertices, faces, uvs, weights, reach.astype(np.float32), fabric=fabric, solid=False)
